"""Table of the devices and their kernels, read once when a pipeline is created."""

import dataclasses
import functools
import importlib
import importlib.util
import logging
from typing import Any, Final

from ertis_numba.base import checks
from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels import _numba_setup
from ertis_numba.kernels._contract.fusion import FusionKernels
from ertis_numba.kernels._contract.mapping import MappingKernels
from ertis_numba.kernels._contract.points import PointKernels
from ertis_numba.kernels._contract.steering import SteeringKernels
from ertis_numba.kernels._kernel_set import KernelSet

__all__ = [
    "DEVICES",
    "load",
    "load_fusion",
    "load_host",
    "load_mapping",
    "load_points",
    "load_steering",
    "require_numba",
    "usable",
]

_LOG = logging.getLogger("ertis_numba")

DEVICES: Final = {
    "cpu": "ertis_numba.kernels._cpu",
    "cuda": "ertis_numba.kernels._cuda.gpu",
    "numpy": "ertis_numba.kernels._numpy",
}
"""Module of each device's kernels. Importing it also imports the device's libraries."""


@functools.cache
def load(device: str = "auto") -> KernelSet:
    """Return the kernels of a device; "auto" is "cuda" if a GPU and its libraries are available, else `load_host`."""
    # Raise ArgumentError for an unknown device, and DeviceError for one that cannot be used on this machine.
    checks.choice("device", device, ("auto", *DEVICES))
    if device == "auto":
        chosen = load("cuda") if _has_gpu() else load_host()
        _LOG.info("device 'auto' is %r", chosen.device)
        return chosen
    try:
        if device != "numpy":
            _numba_setup.prepare()
        kernels: KernelSet = importlib.import_module(DEVICES[device]).KERNELS
    except DeviceError:
        raise
    except ImportError as error:
        if device != "cuda" or (error.name or "").startswith("ertis_numba"):  # a fault of a kernel, not of the machine
            raise
        # Numba will drop its own CUDA target; the package numba-cuda continues it.
        raise DeviceError(
            f"device {device!r} cannot be loaded ({error}); use device 'cpu', or install ertis-numba[cu12] or [cu13]"
        ) from error
    return kernels


@functools.cache
def load_host() -> KernelSet:
    """Return the kernels of device "cpu"; those of "numpy", with a warning, if Numba cannot be imported."""
    reason = _numba_setup.import_error()
    if reason:
        _LOG.warning(
            "NumPy replaces Numba, which cannot be imported (%s), and takes longer; run 'pip install numba'",
            reason,
        )
    return load("numpy" if reason else "cpu")


@functools.cache
def load_fusion() -> FusionKernels:
    """Return the kernels of fusion: compiled ones, or those of NumPy if none can be compiled on this machine."""
    kernels: FusionKernels = _compiled("fusion")
    return kernels


@functools.cache
def load_mapping() -> MappingKernels:
    """Return the kernels of occupancy maps: compiled ones, or those of NumPy if none can be compiled here."""
    kernels: MappingKernels = _compiled("mapping")
    return kernels


@functools.cache
def load_points() -> PointKernels:
    """Return the kernels of points: compiled ones, or those of NumPy if none can be compiled on this machine."""
    kernels: PointKernels = _compiled("points")
    return kernels


@functools.cache
def load_steering(device: str = "auto") -> SteeringKernels:
    """Return the steering kernels of the host, also for a GPU; "auto" falls back to NumPy without a compiler."""
    checks.choice("device", device, ("auto", "numpy"))
    kernels: SteeringKernels = _compiled("steering") if device == "auto" else _in_numpy("steering")
    return kernels


def _compiled(name: str) -> Any:
    """Return the compiled kernels of a module, or their twins of NumPy."""
    try:
        load("cpu")
    except DeviceError as error:
        _LOG.info("%s uses NumPy: %s", name, error)
        return _in_numpy(name)
    kernels = importlib.import_module(f"ertis_numba.kernels._cpu.{name}").KERNELS
    loading = importlib.import_module("ertis_numba.kernels._cpu.loading")
    loading.load_without_compiler(getattr(kernels, field.name) for field in dataclasses.fields(kernels))
    return kernels


def _in_numpy(name: str) -> Any:
    return importlib.import_module(f"ertis_numba.kernels._numpy_{name}").KERNELS


def require_numba(user: str) -> None:
    """Raise DeviceError, which names the user, if Numba cannot be imported on this machine."""
    reason = _numba_setup.import_error()
    if reason:
        raise DeviceError(
            f"{user} needs Numba, which cannot be imported ({reason}); install it with 'pip install numba'"
        )


def usable() -> tuple[str, ...]:
    """Return the names of devices that `load` can load on this machine; log reasons for missing ones at level INFO."""
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
    """Return True if ``auto`` selects a GPU; without CuPy, none is searched for."""
    if importlib.util.find_spec("cupy") is None:
        return False
    try:
        return not load("cuda").simulated
    except Exception as error:  # noqa: BLE001 - whatever a driver raises, the CPU is available
        _LOG.info("%s", error)
        return False
