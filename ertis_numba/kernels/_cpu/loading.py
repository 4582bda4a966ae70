"""Loading of compiled kernels from Numba's cache.

Before Numba loads a function, it prepares its compiler and looks for extensions in the metadata of all installed
packages: a tenth of the processor time of ``ertis process``. Only a compilation needs either.
"""

import functools
import logging
from collections.abc import Callable, Iterable
from typing import Any, Final

from llvmlite import binding
from numba.core import entrypoints
from numba.core.caching import FunctionCache
from numba.core.runtime import _nrt_python

__all__ = ["load_without_compiler"]

_LOG: Final = logging.getLogger("ertis_numba")


def load_without_compiler(kernels: Iterable[Any]) -> None:
    """Let kernels load from Numba's cache without preparing its compiler."""
    for kernel in kernels:
        cache = getattr(kernel, "_cache", None)
        if isinstance(cache, FunctionCache) and hasattr(cache, "_load_overload"):
            cache.load_overload = functools.partial(_load, cache)
            kernel._compilation_chain_init_hook = _nothing  # noqa: SLF001
            cache.save_overload = functools.partial(_save, cache.save_overload, cache)


def _save(save: Callable[[Any, Any], None], cache: Any, signature: Any, compiled: Any) -> None:
    """Store compiled code; if the disk is full, work without."""
    try:
        save(signature, compiled)
    except OSError as error:
        _warn_of_compilations(cache.cache_path, error.strerror)


@functools.cache
def _warn_of_compilations(folder: str, reason: str) -> None:
    """Warn once for each folder."""
    _LOG.warning(
        "compiled kernels cannot be stored in %s (%s), so each process compiles them again; free space on that disk, "
        "or set NUMBA_CACHE_DIR to a folder on another",
        folder,
        reason,
    )


def _nothing() -> None:
    pass


@functools.cache
def _register_runtime() -> None:
    """Register the functions that stored code calls. Numba's own function also compiles some: 20 ms and 20 MB."""
    for name, address in _nrt_python.c_helpers.items():
        binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def _load(cache: Any, signature: Any, context: Any) -> Any:
    """Return the compiled code for a signature, or None if there is none, like `FunctionCache.load_overload`."""
    found = _stored(cache, signature, context)
    if found is None:
        entrypoints.init_all()
    return found


def _stored(cache: Any, signature: Any, context: Any) -> Any:
    # Numba reads all types before it compares the age of the source; a cache with a renamed type is emptied.
    _register_runtime()
    try:
        with cache._guard_against_spurious_io_errors():  # noqa: SLF001 - Numba has no public function for this
            return cache._load_overload(signature, context)  # noqa: SLF001
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001
        _LOG.info("compiled kernels in %s are of another version and are replaced (%s)", cache.cache_path, error)
        cache.flush()
        return None
