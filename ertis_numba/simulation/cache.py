"""Cache of intermediate results with a limited size."""

import dataclasses
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar

import numpy as np

__all__ = ["Cache"]

Found = TypeVar("Found")
_MAX_BYTES = 2**27
_TEXT_BYTES = 100  # of a name of a sound path


class Cache:
    """Results by key; if they exceed a total size, the least recently used are discarded.

    Parameters
    ----------
    max_bytes : int, optional
        Largest total size of the results in bytes; 128 MiB by default.
    """

    def __init__(self, max_bytes: int = _MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._results: OrderedDict[object, tuple[object, int]] = OrderedDict()
        self._n_bytes = 0

    def once(self, key: object, make: Callable[[], Found]) -> Found:
        """Return the result for a key. The function ``make`` computes it, if it is not stored."""
        if key in self._results:
            self._results.move_to_end(key)
            known: Found = self._results[key][0]  # type: ignore[assignment]  # each key has results of one type
            return known
        found = make()
        self._results[key] = found, _n_bytes(found)
        self._n_bytes += self._results[key][1]
        while self._n_bytes > self._max_bytes and len(self._results) > 1:
            _, (_, n_bytes) = self._results.popitem(last=False)
            self._n_bytes -= n_bytes
        return found


def _n_bytes(found: object) -> int:
    """Return the approximate size of a result in bytes."""
    if isinstance(found, np.ndarray):
        return found.nbytes
    if isinstance(found, tuple | list) and found and isinstance(found[0], str):
        return _TEXT_BYTES * len(found)
    if isinstance(found, tuple | list):
        return sum(map(_n_bytes, found))
    if dataclasses.is_dataclass(found):
        return sum(_n_bytes(getattr(found, each.name)) for each in dataclasses.fields(found))
    return 0
