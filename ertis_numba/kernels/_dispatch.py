"""One table from a device's name to its kernels, read once when a pipeline is made."""

import functools
import importlib
import logging
from typing import Final

from ertis_numba import checks
from ertis_numba.errors import DeviceError
from ertis_numba.kernels._contract import KernelSet

__all__ = ["DEVICES", "load"]

_LOG = logging.getLogger("ertis_numba")

DEVICES: Final = {"cpu": "ertis_numba.kernels._cpu", "numpy": "ertis_numba.kernels._numpy"}
"""Module of each device's kernels. Importing one is what brings its libraries in."""


@functools.cache
def load(device: str = "auto") -> KernelSet:
    """Return the kernels of ``device``: ``auto``, ``cpu`` (Numba) or ``numpy`` (plain, for comparison).

    Raises
    ------
    ArgumentError
        The device is unknown.
    DeviceError
        The device is known but cannot be used here.
    """
    if device == "cuda":
        raise DeviceError("device 'cuda' has no kernels in this version; use device 'cpu'")
    checks.choice("device", device, ("auto", *DEVICES))
    if device == "auto":
        _LOG.info("device 'auto' is 'cpu'")
        return load("cpu")
    try:
        kernels: KernelSet = importlib.import_module(DEVICES[device]).KERNELS
    except DeviceError:
        raise
    except RuntimeError as error:  # Numba's, where it can write its cache nowhere
        raise DeviceError(
            f"device {device!r} cannot be set up ({error}); set NUMBA_CACHE_DIR to a folder that can be written"
        ) from error
    return kernels
