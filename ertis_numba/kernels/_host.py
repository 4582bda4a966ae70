"""Memory of kernels that run on the CPU: NumPy arrays, used in place."""

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.kernels._device_protocols import Array
from ertis_numba.kernels._images import ImagePool

__all__ = ["HostMemory"]


class _HostLane:
    """Lane of the host: no array is copied, and every call finishes before it returns. See `Lane`."""

    stream = None

    def entered(self) -> AbstractContextManager[None]:
        """Run the enclosed kernels of this Python thread on this lane."""
        return contextlib.nullcontext()

    def send(self, array: Array) -> Array:
        """Start to copy an array of the host to the device, and return the copy."""
        return array

    def target(self, out: Array) -> Array:
        """Return the array of the device that `fetch` copies to ``out``."""
        return out

    def run(self, steps: Callable[[], None]) -> None:
        """Start ``steps``, which must use the same arrays at each call; a lane may record and replay them."""
        steps()

    def fetch(self, array: Array, out: Array) -> None:
        """Start to copy an array of the device, such as the result of `target`, to ``out``."""
        if array is not out:
            out[...] = array

    def wait(self) -> None:
        """Block until all operations on this lane are complete."""


class HostMemory:
    """Memory of the host. See `Memory`."""

    n_lanes = 1

    def __init__(self, *, graphs: bool | None = None) -> None:
        if graphs:
            raise ArgumentError(
                "graphs is True, but only device 'cuda' has CUDA graphs; remove graphs, or use device 'cuda'"
            )
        self._images = ImagePool(lambda shape: np.empty(shape, np.float32))

    def table(self, array: Array) -> Array:
        """Return ``array``, not to be modified, in C order: Numba compiles a kernel again for each other order."""
        return cast("Array", np.ascontiguousarray(array).reshape(array.shape))

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return a new array of zeros on the device."""
        return np.zeros(shape, dtype)

    def image(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return an unused, uninitialised array of the host to which `Lane.fetch` is fast."""
        return self._images.take(shape)

    def lane(self) -> _HostLane:
        """Return a new lane."""
        return _HostLane()

    def close(self) -> None:
        """Free all unreferenced memory immediately."""
        self._images.close()
