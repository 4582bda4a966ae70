"""Check of Numba's environment variables, and a folder for its cache, before kernels are loaded."""

import functools
import importlib
import logging
import os
import stat
import tempfile
import warnings
from pathlib import Path
from typing import Any, Final

from ertis_numba.base.errors import DeviceError

__all__ = ["import_error", "prepare"]

_LOG = logging.getLogger("ertis_numba")
_REMEDY: Final = "set NUMBA_CACHE_DIR to a writable folder"
_POOLS: Final = {
    "default": "",
    "forksafe": "",
    "omp": "omppool",
    "safe": "tbbpool",
    "tbb": "tbbpool",
    "threadsafe": "omppool",
    "workqueue": "",
}
"""Modules that Numba's threading layers need."""


def prepare() -> None:
    """Import Numba, and ensure that it can start threads and store compiled kernels."""
    config = _imported().config
    layer = str(config.THREADING_LAYER).lower()
    if layer not in _POOLS:
        raise DeviceError(f"NUMBA_THREADING_LAYER is {layer!r}; use one of {', '.join(_POOLS)}, or unset it")
    if set(config.THREADING_LAYER_PRIORITY) != {"tbb", "omp", "workqueue"}:
        raise DeviceError("NUMBA_THREADING_LAYER_PRIORITY must list tbb, omp and workqueue in any order; unset it")
    try:
        importlib.import_module(f"numba.np.ufunc.{_POOLS[layer]}" if _POOLS[layer] else "numba")
    except ImportError as error:
        raise DeviceError(
            f"NUMBA_THREADING_LAYER is {layer!r}, but its library is missing ({error}); unset it"
        ) from error
    _require_cache_folder()


@functools.cache
def import_error() -> str:
    """Return the reason why Numba cannot be imported on this machine; empty if it can."""
    try:
        _imported()
    except DeviceError as error:
        return str(error.__cause__) if isinstance(error.__cause__, (ImportError, OSError)) else ""
    return ""


def _imported() -> Any:
    """Return Numba; raise DeviceError if it is missing, or cannot interpret its environment variables."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", r"\s*Environment variable", RuntimeWarning)
            return importlib.import_module("numba")
    except (ImportError, OSError) as error:  # OSError: llvmlite cannot load its library
        raise DeviceError(
            f"devices 'cpu' and 'cuda' need Numba, which cannot be imported ({error}); install it with 'pip install "
            "numba', or use device 'numpy'"
        ) from error
    except (ValueError, RuntimeWarning) as error:
        given = ", ".join(f"{name}={value}" for name, value in sorted(os.environ.items()) if name.startswith("NUMBA_"))
        reason = str(error).split("\n")[0].strip()
        raise DeviceError(
            f"Numba refuses one of its environment variables, {given} ({reason}); correct or unset this variable"
        ) from error


def _require_cache_folder() -> None:
    """Let Numba store compiled kernels in a private temporary folder if no other folder is writable."""
    numba = _imported()
    if numba.config.DISABLE_JIT:  # Nothing is stored.
        return
    wanted = numba.config.CACHE_DIR
    found = _cache_folder(numba)
    if found is not None:
        if wanted and not Path(found).is_relative_to(wanted):
            _LOG.warning("NUMBA_CACHE_DIR, %s, is not writable; compiled kernels are stored in %s", wanted, found)
        return
    try:
        folder = _private_folder()
    except OSError as error:
        raise DeviceError(f"no folder for compiled kernels is writable ({error}); {_REMEDY}") from error
    os.environ["NUMBA_CACHE_DIR"] = str(folder)  # for child processes as well
    numba.config.reload_config()
    _LOG.warning("compiled kernels are stored in %s, as no other folder is writable; to keep them, %s", folder, _REMEDY)


def _cache_folder(numba: Any) -> str | None:
    """Return the folder in which Numba stores the kernels of this package; None if no folder is writable."""
    try:
        return str(numba.njit(cache=True)(_private_folder).stats.cache_path)
    except RuntimeError:
        return None


def _private_folder() -> Path:
    """Return a temporary folder that no other user can write to, because Numba runs the code in its cache."""
    if not hasattr(os, "getuid"):
        return Path(tempfile.mkdtemp(prefix="ertis-numba-"))
    folder = Path(tempfile.gettempdir(), f"ertis-numba-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    is_private = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
    return folder if is_private else Path(tempfile.mkdtemp(prefix="ertis-numba-"))
