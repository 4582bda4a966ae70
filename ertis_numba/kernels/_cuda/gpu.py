"""Kernels on the GPU of this machine; importing this module searches for one."""

import importlib
import importlib.util

from numba import cuda

from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels._cuda import kernel_set
from ertis_numba.kernels._cuda.lane import SIMULATED
from ertis_numba.kernels._cuda.memory import CudaMemory

__all__ = ["KERNELS"]

_REMEDY = (
    "use device 'cpu', or install ertis-numba[cu12] or [cu13] on a machine with an NVIDIA GPU: see docs/how-to/cuda.md"
)


def _hardware() -> str:
    """Return the name of the GPU; raise DeviceError if it or a library that it needs is missing."""
    if SIMULATED:
        return "Numba's CUDA simulator"
    # Checked first, because the target that Numba itself still ships crashes on newer drivers.
    if importlib.util.find_spec("numba_cuda") is None:
        raise DeviceError(f"device 'cuda' needs numba-cuda, which is not installed; {_REMEDY}")
    if not cuda.is_available():
        reason = " ".join(str(cuda.cuda_error() or "none is visible").split())
        raise DeviceError(f"device 'cuda' finds no NVIDIA GPU ({reason}); {_REMEDY}")
    try:
        importlib.import_module("cupy.cuda.cufft")
    except ImportError as error:
        reason = " ".join(str(error).split())
        raise DeviceError(
            f"device 'cuda' needs CuPy with cuFFT, which cannot be loaded ({reason}); {_REMEDY}"
        ) from error
    name = cuda.get_current_device().name
    return str(name.decode() if isinstance(name, bytes) else name)


KERNELS = kernel_set(hardware=_hardware(), transforms="scipy" if SIMULATED else "cufft", memory=CudaMemory)
