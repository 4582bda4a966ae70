"""Memory that processes share, without a name: the system takes it back when the last of them is gone."""

import mmap
import os
import tempfile
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

__all__ = ["POINTS_BYTES", "Slot", "SlotView"]

POINTS_BYTES: Final = 65_536
"""Room for the points of an image."""

_PAGE: Final = 4096


def _paged(n_bytes: int) -> int:
    return -(-n_bytes // _PAGE) * _PAGE


class SlotView:
    """What one process sees of a slot: the words of a measurement, its image, its points.

    Parameters
    ----------
    descriptor : int
        Of the memory; it may be closed afterwards.
    words_bytes, image_bytes : int
        Room for them.
    """

    def __init__(self, descriptor: int, words_bytes: int, image_bytes: int) -> None:
        self._image = _paged(words_bytes)
        self._points = self._image + _paged(image_bytes)
        self._map = mmap.mmap(descriptor, self._points + POINTS_BYTES)

    def words(self, n_bytes: int) -> memoryview:
        """Return the first bytes of the words."""
        return memoryview(self._map)[:n_bytes]

    def image(self, n_bytes: int) -> memoryview:
        """Return the first bytes of the image."""
        return memoryview(self._map)[self._image : self._image + n_bytes]

    def points(self, n_bytes: int) -> memoryview:
        """Return the first bytes of the points."""
        return memoryview(self._map)[self._points : self._points + n_bytes]

    def image_as(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return the image as an array."""
        dtype = np.dtype(dtype)
        return np.frombuffer(self.image(int(np.prod(shape)) * dtype.itemsize), dtype).reshape(shape)


class Slot:
    """Memory for one measurement and what is made of it.

    A file in memory without a name, rather than one of `multiprocessing.shared_memory`: nothing is left behind even if
    every process is killed at once.

    Parameters
    ----------
    number : int
        By which processes speak of it.
    words_bytes, image_bytes : int
        Room for them.

    Attributes
    ----------
    descriptor : int
        To be sent to the processes that are to see it.
    view : View
    """

    def __init__(self, number: int, words_bytes: int, image_bytes: int) -> None:
        self.number, self.words_bytes, self.image_bytes = number, words_bytes, image_bytes
        self.descriptor = _nameless()
        try:
            os.ftruncate(self.descriptor, _paged(words_bytes) + _paged(image_bytes) + POINTS_BYTES)
            self.view = SlotView(self.descriptor, words_bytes, image_bytes)
        except BaseException:
            os.close(self.descriptor)
            raise

    def holds(self, words_bytes: int, image_bytes: int) -> bool:
        """Whether there is room for them."""
        return words_bytes <= self.words_bytes and image_bytes <= self.image_bytes

    def close(self) -> None:
        """Let go of it; others keep what they see."""
        os.close(self.descriptor)


def _nameless() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("ertis")
    with tempfile.TemporaryFile() as file:  # where there is no such thing, a file that has lost its name
        return os.dup(file.fileno())
