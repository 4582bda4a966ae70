"""Missing sequence numbers with their reasons."""

import bisect
from collections.abc import Iterable, Iterator, Sequence

from ertis_numba.frames import SequenceGap

__all__ = ["UNKNOWN", "SensorSequences", "SequenceNumbers"]

Range = tuple[int, int]
ReasonedRange = tuple[int, int, str]

UNKNOWN = "not among the measurements given"
"""Reason of a gap without a noted reason."""

_END = 2**63  # Above all sequence numbers.


class SensorSequences:
    """Sequence numbers of a sensor's sessions, and the missing ones."""

    def __init__(self) -> None:
        self._numbers: dict[int, SequenceNumbers] = {}

    def contains(self, number: int, session_id: int) -> bool:
        """Return True if a number of a session has arrived."""
        return session_id in self._numbers and number in self._numbers[session_id]

    def add(self, number: int, session_id: int) -> None:
        """Add the next number of a session."""
        self._numbers.setdefault(session_id, SequenceNumbers()).add(number)

    def missing(self, sensor: str, noted: Iterable[SequenceGap]) -> list[SequenceGap]:
        """Return the gaps of all sessions, given noted ones: in order of arrival, then sessions without a number."""
        known: dict[int, list[ReasonedRange]] = {}
        for gap in noted:
            known.setdefault(gap.session_id, []).append((gap.first, gap.last, gap.reason))
        return [
            SequenceGap(sensor, *hole, session_id)
            for session_id in (*self._numbers, *sorted(known.keys() - self._numbers.keys()))
            for hole in self._numbers.get(session_id, SequenceNumbers()).missing(known.get(session_id, ()))
        ]


class SequenceNumbers:
    """Sequence numbers of one session in order of arrival, and missing ones between them as ``jumps`` (first, last)."""

    def __init__(self) -> None:
        self.jumps: list[Range] = []
        self._first: int | None = None
        self._last = 0
        self._highest = -1
        self._skipped: list[Range] = []  # Below the highest number at that time; some may have arrived late.
        self._late: set[int] = set()  # Numbers that did not rise.

    def __contains__(self, number: int) -> bool:
        return number in self._late or (
            number <= self._highest and not any(_intersection((number, number), self._skipped))
        )

    def add(self, number: int) -> None:
        """Add the next number."""
        if self._first is None:
            self._first = number
        elif number > self._last + 1:
            self.jumps.append((self._last + 1, number - 1))
        if number <= self._highest:
            self._late.add(number)
        else:
            if number > self._highest + 1:
                self._skipped.append((self._highest + 1, number - 1))
            self._highest = number
        self._last = number

    def missing(self, noted: Iterable[ReasonedRange]) -> list[ReasonedRange]:
        """Return the missing numbers in order: first, last and reason; neighbours with one reason are merged."""
        # Without session identifiers, all noted gaps are missing. Of overlapping ones, the first has priority.
        known = list(_disjoint(noted))
        if self._first is not None and not self._late:
            absent = [(-_END, self._first - 1), *self.jumps, (self._last + 1, _END)]
            known = [(first, last, item[2]) for item in known for first, last in _intersection(item[:2], absent)]
        holes = [item[:2] for item in known]
        unknown = [(first, last, UNKNOWN) for jump in self.jumps for first, last in _difference(jump, holes)]
        return list(_merged(sorted(known + unknown)))


def _disjoint(noted: Iterable[ReasonedRange]) -> Iterator[ReasonedRange]:
    end = -_END
    for first, last, reason in sorted(noted, key=lambda item: item[0]):
        if last > end:
            yield max(first, end + 1), last, reason
            end = last


def _intersection(given: Range, others: Sequence[Range]) -> Iterator[Range]:
    """Yield the intersection of a range with other ranges, which are in order and do not overlap."""
    for index in range(bisect.bisect_left(others, given[0], key=lambda other: other[1]), len(others)):
        first, last = others[index]
        if first > given[1]:
            return
        yield max(first, given[0]), min(last, given[1])


def _difference(given: Range, others: Sequence[Range]) -> Iterator[Range]:
    """Yield the difference between a range and other ranges, which are in order and do not overlap."""
    begin, end = given
    for first, last in _intersection(given, others):
        if first > begin:
            yield begin, first - 1
        begin = last + 1
    if begin <= end:
        yield begin, end


def _merged(missing: Iterable[ReasonedRange]) -> Iterator[ReasonedRange]:
    held: ReasonedRange | None = None
    for item in missing:
        if held is not None and held[2] == item[2] and held[1] + 1 == item[0]:
            held = (held[0], item[1], item[2])
            continue
        if held is not None:
            yield held
        held = item
    if held is not None:
        yield held
