"""Anonymous memory shared between processes, freed by the system with the last of them."""

import math
import mmap
import os
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ertis_numba.processes import anonymous_memory

__all__ = ["POINTS_BYTES", "Slot", "SlotPool", "SlotView"]

POINTS_BYTES: Final = 65_536
"""Room for the points of an image."""

_PAGE: Final = 4096


def _paged(n_bytes: int) -> int:
    return -(-n_bytes // _PAGE) * _PAGE


class SlotView:
    """Access of one process to a slot: samples, image and points; the descriptor may be closed afterwards."""

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
    """Memory for one measurement and its products."""

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


class SlotPool:
    """Slots that are used again once they are free; their numbers limit how many are in use at the same time."""

    def __init__(self, numbers: Iterable[int]) -> None:
        self._numbers = iter(numbers)
        self._all: dict[int, Slot] = {}
        self._free: list[Slot] = []

    def take(self, words_bytes: int, image_bytes: int) -> Slot | None:
        """Return a slot in which a measurement and an image of these sizes fit; None if all are in use."""
        for slot in self._free:
            if slot.holds(words_bytes, image_bytes):
                self._free.remove(slot)
                return slot
        number = next(self._numbers, None)
        if number is None and self._free:
            number = self._free.pop(0).number
            self._all.pop(number).close()
        if number is None:
            return None
        self._all[number] = slot = Slot(number, words_bytes, image_bytes)
        return slot

    def release(self, slot: Slot) -> None:
        """Accept a slot that is no longer in use."""
        self._free.append(slot)

    def close(self) -> None:
        """Release the memory of all slots."""
        for slot in self._all.values():
            slot.close()
        self._all.clear()
        self._free.clear()
