"""Arrays for images, handed out again when nobody looks at them any more.

To make one takes as long as an image does: its pages come one by one from the operating system, and to pin them for
a GPU takes longer still.
"""

import threading
import weakref
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["ImagePool"]

_MAX_BYTES = 2**28  # of all arrays that are kept: who holds on to more images gets arrays of their own


class _Lease:
    """What an image refers to as long as anybody looks at it, or at a part of it."""

    def __init__(self, array: NDArray[np.float32]) -> None:
        self.__array_interface__ = array.__array_interface__


class ImagePool:
    """The images of one pipeline.

    Parameters
    ----------
    make : callable
        Shape to a new array that is worth keeping.
    """

    def __init__(self, make: Callable[[tuple[int, ...]], NDArray[np.float32]]) -> None:
        self._make = make
        self._lock = threading.RLock()  # an image may be given back amid a garbage collection
        self._spare: list[NDArray[np.float32]] = []
        self._count = 0
        self._closed = False

    def take(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return an array, always of the same shape, that nobody looks at and that holds anything."""
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
        """Keep nothing from now on."""
        with self._lock:
            self._closed = True
            self._spare.clear()

    def _release(self, array: NDArray[np.float32]) -> None:
        with self._lock:
            if not self._closed:
                self._spare.append(array)
