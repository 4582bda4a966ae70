"""Pool of image arrays, reused once nothing refers to them.

Allocating an array takes as long as computing an image, and pinning it for a GPU even longer.
"""

import threading
import weakref
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.forks import ForkSafeLock

__all__ = ["ImagePool"]

_MAX_BYTES = 2**28  # total size of pooled arrays; callers that keep more images get separate arrays


class _Lease:
    """Base object of an image; it lives as long as the image or any view of it."""

    def __init__(self, array: NDArray[np.float32]) -> None:
        self.__array_interface__ = array.__array_interface__


class ImagePool:
    """Pool of the images of one pipeline; ``make`` returns a new array of a given shape."""

    def __init__(self, make: Callable[[tuple[int, ...]], NDArray[np.float32]]) -> None:
        self._make = make
        self._lock = ForkSafeLock(threading.RLock)  # garbage collection may release an image while the lock is held
        self._spare: list[NDArray[np.float32]] = []
        self._count = 0
        self._closed = False

    def take(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return an unused, uninitialised array; the shape is the same at every call."""
        with self._lock:
            array = self._spare.pop() if self._spare else None
            if array is None:
                n_bytes = 4 * shape[0] * shape[1]
                if self._closed or (self._count + 1) * n_bytes > _MAX_BYTES:
                    return np.empty(shape, np.float32)
                array = self._make(shape)
                self._count += 1
        lease = _Lease(array)
        weakref.finalize(lease, self._release, array).atexit = False
        return np.asarray(lease)

    def close(self) -> None:
        """Free all unused arrays, and pool no others."""
        with self._lock:
            self._closed = True
            self._spare.clear()

    def _release(self, array: NDArray[np.float32]) -> None:
        with self._lock:
            if not self._closed:
                self._spare.append(array)
