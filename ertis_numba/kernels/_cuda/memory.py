"""What a pipeline keeps on the GPU, and the pinned memory of the host that its images arrive in."""

import threading
import weakref
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numba import cuda
from numba.cuda.cudadrv.driver import CudaAPIError
from numpy.typing import DTypeLike, NDArray

from ertis_numba.errors import DeviceError
from ertis_numba.kernels._contract import Array
from ertis_numba.kernels._cuda.lane import SIMULATED, Lane

__all__ = ["CudaMemory"]

_OUT_OF_MEMORY: Final = 2  # CUDA_ERROR_OUT_OF_MEMORY
_MOST_PINNED = 8  # images: the operating system cannot page out what is pinned, so a user who keeps all gets plain ones


class CudaMemory:
    """See `Memory`."""

    n_lanes = 3  # one measurement on its way in, one in work, one on its way out

    def __init__(self, *, graphs: bool = False) -> None:
        self._graphs = graphs
        self._bytes = 0
        self._images = _Images()

    def table(self, array: Array) -> Array:
        """See `Memory.table`."""
        made: Array = self._made(array.nbytes, lambda: cuda.to_device(np.ascontiguousarray(array)))
        return made

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """See `Memory.zeros`."""
        return self.table(np.zeros(shape, dtype))

    def image(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """See `Memory.image`."""
        return self._images.take(shape)

    def lane(self) -> Lane:
        """See `Memory.lane`."""
        return Lane(cuda.stream(), self._array, graphs=self._graphs)

    def close(self) -> None:
        """See `Memory.close`."""
        self._images.close()
        if not SIMULATED:
            cuda.current_context().deallocations.clear()  # Numba puts them off otherwise

    def _array(self, shape: tuple[int, ...], dtype: DTypeLike) -> Any:
        n_bytes = int(np.prod(shape)) * np.dtype(dtype).itemsize
        return self._made(n_bytes, lambda: cuda.device_array(shape, dtype))

    def _made(self, n_bytes: int, make: Callable[[], Any]) -> Any:
        """Return what ``make`` allocates, counted.

        Raises
        ------
        DeviceError
            It does not fit.
        """
        try:
            made = make()
        except CudaAPIError as error:
            if int(error.args[0]) != _OUT_OF_MEMORY:
                raise
            free, total = cuda.current_context().get_memory_info()
            raise DeviceError(
                f"device 'cuda' has {free / 1e6:,.0f} of {total / 1e6:,.0f} MB free, and this pipeline needs "
                f"{n_bytes / 1e6:,.0f} MB more than the {self._bytes / 1e6:,.0f} MB that it has; "
                "give fewer directions, a shorter processing.range_m or less accuracy.oversampling, close other "
                "pipelines, or use device 'cpu'"
            ) from error
        self._bytes += n_bytes
        return made


class _Lease:
    """What an image refers to as long as anybody looks at it, or at a part of it."""

    def __init__(self, pinned: NDArray[np.float32]) -> None:
        self.__array_interface__ = pinned.__array_interface__


class _Images:
    """Pinned arrays, handed out again when nobody looks at them any more; pinning takes longer than an image."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._spare: list[NDArray[np.float32]] = []
        self._n_pinned = 0
        self._closed = False

    def take(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        with self._lock:
            pinned = self._spare.pop() if self._spare else None
            if pinned is None and self._n_pinned == _MOST_PINNED:
                return np.empty(shape, np.float32)
            self._n_pinned += pinned is None
        if pinned is None or pinned.shape != shape:
            pinned = cuda.pinned_array(shape, np.float32)
        lease = _Lease(pinned)
        weakref.finalize(lease, self._give_back, pinned).atexit = False
        return np.asarray(lease)

    def close(self) -> None:
        with self._lock:
            self._closed = True
            self._spare.clear()

    def _give_back(self, pinned: NDArray[np.float32]) -> None:
        with self._lock:
            if not self._closed:
                self._spare.append(pinned)
