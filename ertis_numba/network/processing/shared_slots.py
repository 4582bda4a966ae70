"""Anonymous memory shared between processes, freed by the system with the last of them."""

import math
import mmap
import os
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ertis_numba.processes import anonymous_memory

__all__ = ["POINTS_BYTES", "Slot", "SlotView"]

POINTS_BYTES: Final = 65_536
"""Room for the points of an image."""

_PAGE: Final = 4096


def _paged(n_bytes: int) -> int:
    return -(-n_bytes // _PAGE) * _PAGE


class SlotView:
    """Access of one process to a slot: the samples of a measurement, its image, its points.

    Parameters
    ----------
    descriptor : int
        Descriptor of the memory; it may be closed afterwards.
    words_bytes, image_bytes : int
        Sizes.
    """

    def __init__(self, descriptor: int, words_bytes: int, image_bytes: int) -> None:
        self._image = _paged(words_bytes)
        self._points = self._image + _paged(image_bytes)
        self._map = mmap.mmap(descriptor, self._points + POINTS_BYTES)

    def words(self, n_bytes: int) -> memoryview:
        """Return the first bytes of the samples."""
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
        return np.frombuffer(self.image(math.prod(shape) * dtype.itemsize), dtype).reshape(shape)


class Slot:
    """Memory for one measurement and its products.

    Parameters
    ----------
    number : int
        Number by which processes refer to it.
    words_bytes, image_bytes : int
        Sizes.

    Attributes
    ----------
    descriptor : int
        Descriptor for the processes that use it.
    view : SlotView
    """

    def __init__(self, number: int, words_bytes: int, image_bytes: int) -> None:
        self.number, self.words_bytes, self.image_bytes = number, words_bytes, image_bytes
        self.descriptor = anonymous_memory(_paged(words_bytes) + _paged(image_bytes) + POINTS_BYTES)
        try:
            self.view = SlotView(self.descriptor, words_bytes, image_bytes)
        except BaseException:
            os.close(self.descriptor)
            raise

    def holds(self, words_bytes: int, image_bytes: int) -> bool:
        """Return True if a measurement and an image of these sizes fit."""
        return words_bytes <= self.words_bytes and image_bytes <= self.image_bytes

    def close(self) -> None:
        """Release it; other processes keep their access."""
        os.close(self.descriptor)
