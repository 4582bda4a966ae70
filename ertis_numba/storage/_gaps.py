"""Which sequence numbers are missing, and why."""

import bisect
from collections.abc import Iterable, Iterator, Sequence

__all__ = ["UNKNOWN", "Missing", "Numbers"]

Range = tuple[int, int]
Missing = tuple[int, int, str]

UNKNOWN = "not among the measurements given"
"""Reason of a gap of which nobody said more."""

_END = 2**63  # beyond all sequence numbers


class Numbers:
    """The sequence numbers of a sensor, as they come, and what is missing among them.

    Attributes
    ----------
    jumps : list of (first, last)
        Missing from one number to the next.
    """

    def __init__(self) -> None:
        self.jumps: list[Range] = []
        self._first: int | None = None
        self._last = 0
        self._rises = True

    def add(self, number: int) -> None:
        """Take the next number."""
        if self._first is None:
            self._first = number
        else:
            if number > self._last + 1:
                self.jumps.append((self._last + 1, number - 1))
            self._rises = self._rises and number > self._last
        self._last = number

    def missing(self, noted: Iterable[Missing]) -> list[Missing]:
        """Return what is missing, in order: first, last and reason; neighbours with one reason are one.

        Where the numbers rise, what is noted is missing if it lies outside of them or in a jump. Where they start
        again, nothing shows which of two equal ones is meant, and all that is noted is missing.

        Parameters
        ----------
        noted : iterable of (first, last, reason)
            What somebody knows about. Where two overlap, the one that begins first is believed.
        """
        known = list(_disjoint(noted))
        if self._first is not None and self._rises:
            absent = [(-_END, self._first - 1), *self.jumps, (self._last + 1, _END)]
            known = [(first, last, item[2]) for item in known for first, last in _shared(item[:2], absent)]
        holes = [item[:2] for item in known]
        unknown = [(first, last, UNKNOWN) for jump in self.jumps for first, last in _less(jump, holes)]
        return list(_joined(sorted(known + unknown)))


def _disjoint(noted: Iterable[Missing]) -> Iterator[Missing]:
    end = -_END
    for first, last, reason in sorted(noted, key=lambda item: item[0]):
        if last > end:
            yield max(first, end + 1), last, reason
            end = last


def _shared(given: Range, others: Sequence[Range]) -> Iterator[Range]:
    """Yield what a range has in common with others, which are in order and do not overlap."""
    for index in range(bisect.bisect_left(others, given[0], key=lambda other: other[1]), len(others)):
        first, last = others[index]
        if first > given[1]:
            return
        yield max(first, given[0]), min(last, given[1])


def _less(given: Range, others: Sequence[Range]) -> Iterator[Range]:
    """Yield what a range has beyond others, which are in order and do not overlap."""
    begin, end = given
    for first, last in _shared(given, others):
        if first > begin:
            yield begin, first - 1
        begin = last + 1
    if begin <= end:
        yield begin, end


def _joined(missing: Iterable[Missing]) -> Iterator[Missing]:
    held: Missing | None = None
    for item in missing:
        if held is not None and held[2] == item[2] and held[1] + 1 == item[0]:
            held = (held[0], item[1], item[2])
            continue
        if held is not None:
            yield held
        held = item
    if held is not None:
        yield held
