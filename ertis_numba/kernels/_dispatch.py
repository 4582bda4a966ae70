"""One table from a device's name to its kernels, read once when a pipeline is made."""

import functools
import importlib
import importlib.util
import logging
from typing import Final

from ertis_numba import checks
from ertis_numba.errors import DeviceError
from ertis_numba.kernels._kernel_set import KernelSet

__all__ = ["DEVICES", "load", "usable"]

_LOG = logging.getLogger("ertis_numba")

DEVICES: Final = {
    "cpu": "ertis_numba.kernels._cpu",
    "cuda": "ertis_numba.kernels._cuda.gpu",
    "numpy": "ertis_numba.kernels._numpy",
}
"""Module of each device's kernels. Importing one is what brings its libraries in."""


@functools.cache
def load(device: str = "auto") -> KernelSet:
    """Return the kernels of a device.

    Parameters
    ----------
    device : {"auto", "cpu", "cuda", "numpy"}
        ``cpu`` is Numba on all cores, ``cuda`` Numba on an NVIDIA GPU, ``numpy`` plain and for comparison. ``auto`` is
        ``cuda`` where there are a GPU and all that it needs, else ``cpu``.

    Raises
    ------
    ArgumentError
        The device is unknown.
    DeviceError
        The device is known but cannot be used here.
    """
    checks.choice("device", device, ("auto", *DEVICES))
    if device == "auto":
        chosen = "cuda" if _has_gpu() else "cpu"
        _LOG.info("device 'auto' is %r", chosen)
        return load(chosen)
    try:
        kernels: KernelSet = importlib.import_module(DEVICES[device]).KERNELS
    except DeviceError:
        raise
    except ImportError as error:
        if device != "cuda":
            raise
        # Numba has announced to drop its own CUDA target; numba-cuda is where it lives on.
        raise DeviceError(
            f"device {device!r} cannot be loaded ({error}); use device 'cpu', or install ertis-numba[cu12] or [cu13]"
        ) from error
    except RuntimeError as error:  # Numba's, where it can write its cache nowhere
        raise DeviceError(
            f"device {device!r} cannot be set up ({error}); set NUMBA_CACHE_DIR to a folder that can be written"
        ) from error
    return kernels


def usable() -> tuple[str, ...]:
    """Return the devices that `load` can load here."""
    found = []
    for device in DEVICES:
        try:
            load(device)
        except DeviceError as error:
            _LOG.info("%s", error)
        else:
            found.append(device)
    return tuple(found)


def _has_gpu() -> bool:
    """Whether ``auto`` takes a GPU; looked for only where CuPy tells that somebody meant to use one."""
    if importlib.util.find_spec("cupy") is None:
        return False
    try:
        return not load("cuda").simulated
    except Exception as error:  # noqa: BLE001 - whatever a driver may raise, there is a processor
        _LOG.info("%s", error)
        return False
