"""Cache of intermediate results with a limited size."""

import dataclasses
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar

__all__ = ["Cache"]

Found = TypeVar("Found")
_MAX_BYTES = 2**27
_TEXT_BYTES = 100  # of a name of a sound path
_OBJECT_BYTES = 100  # of an object without its content, such as an array
_KEY_BYTES = 1000  # of a key, which contains a set of effects


class Cache:
    """Results by key; beyond ``max_bytes``, the least recently used are discarded, but one result is always kept."""

    def __init__(self, max_bytes: int = _MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._results: OrderedDict[object, tuple[object, int]] = OrderedDict()
        self._n_bytes = 0

    @property
    def n_bytes(self) -> int:
        """Approximate size of the stored results in bytes."""
        return self._n_bytes

    def once(self, key: object, make: Callable[[], Found]) -> Found:
        """Return the result for a key. The function ``make`` computes it, if it is not stored."""
        if key in self._results:
            self._results.move_to_end(key)
            known: Found = self._results[key][0]  # type: ignore[assignment]  # each key has results of one type
            return known
        found = make()
        self._results[key] = found, _KEY_BYTES + _n_bytes(found)
        self._n_bytes += self._results[key][1]
        while self._n_bytes > self._max_bytes and len(self._results) > 1:
            _, (_, n_bytes) = self._results.popitem(last=False)
            self._n_bytes -= n_bytes
        return found


def _n_bytes(found: object) -> int:
    """Return the approximate size of a result in bytes; sizes that objects report themselves come first."""
    if isinstance(found, str):
        return _TEXT_BYTES
    if found is None or isinstance(found, int | float):
        return _OBJECT_BYTES
    n_bytes = getattr(found, "nbytes", None)
    if n_bytes is not None:
        return _OBJECT_BYTES + int(n_bytes)
    if isinstance(found, tuple | list):
        if found and isinstance(found[0], str):
            return _OBJECT_BYTES + _TEXT_BYTES * len(found)
        return _OBJECT_BYTES + sum(map(_n_bytes, found))
    if dataclasses.is_dataclass(found):
        return _OBJECT_BYTES + sum(_n_bytes(getattr(found, each.name)) for each in dataclasses.fields(found))
    raise TypeError(f"size of {type(found).__name__} is unknown; add a property nbytes to it")
