"""Memory of kernels that run on the CPU: NumPy arrays, used in place."""

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ertis_numba.errors import ArgumentError
from ertis_numba.kernels._images import ImagePool
from ertis_numba.kernels._memory import Array

__all__ = ["HostMemory"]


class _HostLane:
    """Lane of the host: no array is copied, and every call finishes before it returns. See `Lane`."""

    stream = None

    def entered(self) -> AbstractContextManager[None]:
        """See `Lane.entered`."""
        return contextlib.nullcontext()

    def send(self, array: Array) -> Array:
        """See `Lane.send`."""
        return array

    def target(self, out: Array) -> Array:
        """See `Lane.target`."""
        return out

    def run(self, steps: Callable[[], None]) -> None:
        """See `Lane.run`."""
        steps()

    def fetch(self, array: Array, out: Array) -> None:
        """See `Lane.fetch`."""
        if array is not out:
            out[...] = array

    def wait(self) -> None:
        """See `Lane.wait`."""


class HostMemory:
    """Memory of the host. See `Memory`."""

    n_lanes = 1

    def __init__(self, *, graphs: bool = False) -> None:
        if graphs:
            raise ArgumentError("graphs is True, but only device 'cuda' has CUDA graphs; leave it out or give 'cuda'")
        self._images = ImagePool(lambda shape: np.empty(shape, np.float32))

    def table(self, array: Array) -> Array:
        """See `Memory.table`."""
        return array

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """See `Memory.zeros`."""
        return np.zeros(shape, dtype)

    def image(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """See `Memory.image`."""
        return self._images.take(shape)

    def lane(self) -> _HostLane:
        """See `Memory.lane`."""
        return _HostLane()

    def close(self) -> None:
        """See `Memory.close`."""
        self._images.close()
