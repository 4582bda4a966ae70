"""Loading of compiled kernels from Numba's cache.

Before Numba loads a function from its cache, it prepares its compiler: it imports its implementation of NumPy, and with
it SciPy's linear algebra. This takes a tenth of the processor time of ``ertis process`` with one measurement. Compiled
code needs neither, and every compilation prepares the compiler itself.
"""

import functools
from collections.abc import Iterable
from typing import Any

from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys

__all__ = ["load_without_compiler"]


def load_without_compiler(kernels: Iterable[Any]) -> None:
    """Let kernels load from Numba's cache without preparing its compiler.

    Kernels that are not cached are compiled as usual. If a future version of Numba loads functions in another way,
    kernels load as Numba does it by default.
    """
    for kernel in kernels:
        cache = getattr(kernel, "_cache", None)
        if isinstance(cache, FunctionCache) and hasattr(cache, "_load_overload"):
            cache.load_overload = functools.partial(_load, cache)


def _load(cache: Any, signature: Any, context: Any) -> Any:
    """Return the compiled code for a signature, or None if there is none, like `FunctionCache.load_overload`."""
    rtsys.initialize(context)  # registers the functions that compiled code calls
    with cache._guard_against_spurious_io_errors():  # noqa: SLF001 - Numba has no public function for this
        return cache._load_overload(signature, context)  # noqa: SLF001
