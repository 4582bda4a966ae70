"""Memory of a pipeline on the GPU, and pinned memory of the host for its images."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numba import cuda
from numba.cuda.cudadrv.driver import CudaAPIError
from numpy.typing import DTypeLike, NDArray

from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels._cuda.lane import SIMULATED, Lane, require_own_process
from ertis_numba.kernels._device_protocols import Array
from ertis_numba.kernels._images import ImagePool

__all__ = ["CudaMemory"]

_OUT_OF_MEMORY: Final = 2  # CUDA_ERROR_OUT_OF_MEMORY


class CudaMemory:
    """Memory of the GPU. See `Memory`."""

    n_lanes = 3  # one measurement being copied in, one being processed, one being copied out

    def __init__(self, *, graphs: bool | None = None) -> None:
        require_own_process()
        self._graphs = graphs is not False  # Graphs make measurements two to three times as fast.
        self._bytes = 0
        self._images = ImagePool(lambda shape: self._pinned(shape, np.float32))

    def table(self, array: Array) -> Array:
        """Return ``array`` on the device. Callers must not modify it afterwards."""
        # NumPy may give an axis of length 1 any stride, and Numba then treats the array as not contiguous.
        compact = np.ascontiguousarray(array)
        if compact.size:  # The order of an empty array does not matter.
            compact = compact.reshape(-1).reshape(array.shape)
        made: Array = self._made(array.nbytes, lambda: cuda.to_device(compact))
        return made

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return a new array of zeros on the device."""
        return self.table(np.zeros(shape, dtype))

    def image(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return an unused, uninitialised array of the host to which `Lane.fetch` is fast."""
        return self._images.take(shape)

    def lane(self) -> Lane:
        """Return a new lane."""
        return Lane(cuda.stream(), self._array, self._pinned, graphs=self._graphs)

    def close(self) -> None:
        """Free all unreferenced memory immediately."""
        self._images.close()
        if not SIMULATED:
            cuda.current_context().deallocations.clear()  # otherwise Numba defers them

    def _array(self, shape: tuple[int, ...], dtype: DTypeLike) -> Any:
        return self._made(_bytes_of(shape, dtype), lambda: cuda.device_array(shape, dtype))

    def _pinned(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return an array of pinned host memory; raise DeviceError if it does not fit."""
        try:
            array: NDArray[Any] = cuda.pinned_array(shape, dtype)
        except CudaAPIError as error:
            if int(error.args[0]) != _OUT_OF_MEMORY:
                raise
            raise DeviceError(
                f"the host cannot pin {_bytes_of(shape, dtype) / 1e6:,.0f} MB for device 'cuda'; raise its limit on "
                "locked memory, close other pipelines, or use device 'cpu'"
            ) from error
        return array

    def _made(self, n_bytes: int, make: Callable[[], Any]) -> Any:
        """Return the array that ``make`` allocates, and count its bytes; raise DeviceError if it does not fit."""
        try:
            made = make()
        except CudaAPIError as error:
            if int(error.args[0]) != _OUT_OF_MEMORY:
                raise
            free, total = cuda.current_context().get_memory_info()
            raise DeviceError(
                f"device 'cuda' has {free / 1e6:,.0f} of {total / 1e6:,.0f} MB free, but this pipeline needs at least "
                f"{n_bytes / 1e6:,.0f} MB in addition to the {self._bytes / 1e6:,.0f} MB that it already uses; "
                "use fewer directions, a shorter processing.range_m or a lower accuracy.oversampling, close other "
                "pipelines, or use device 'cpu'"
            ) from error
        self._bytes += n_bytes
        return made


def _bytes_of(shape: tuple[int, ...], dtype: DTypeLike) -> int:
    return int(np.prod(shape)) * np.dtype(dtype).itemsize
