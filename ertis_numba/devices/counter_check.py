"""Validation of the counters in blocks."""

import bisect
import statistics
from collections import deque
from dataclasses import dataclass
from typing import Final

from ertis_numba.devices.blocks import COUNTERS, Block

__all__ = ["BURST", "CounterCheck"]

BURST: Final = 0.75
"""Share of the shortest interval. Bytes later than this after a block's first byte belong to another trigger."""

_MAX_HELD = 3  # Limit on contradicting blocks, which occupy memory.
_AHEAD = 8  # Allowed excess of a jump over the elapsed time, in numbers: bytes wait in buffers.
_UNHEARD = 4  # Allowed number of successive triggers without a trace, if no later block decides.
_INTERVALS = 8  # Number of kept intervals; of these …
_ALIKE = 6  # … this many …
_REGULAR = 0.03  # … lie this close to their median, relative to it, if triggers are regular.
_FAR = 10  # Number of intervals beyond which the median is too coarse to count them.
_NEAR = 0.15  # Share of an interval: a larger deviation from a whole number means a late arrival.


@dataclass(frozen=True, slots=True)
class _Entry:
    """Block with evidence on its number: all bytes rejected before it, and the burst in which it began."""

    counter: int
    rejected: float
    burst: int
    block: Block | None = None  # None for a counter that was set.


class CounterCheck:
    """Detector of damaged counters, by comparison of blocks.

    1. A number directly after its predecessor, without a rejected byte between them, is correct.
    2. A number that is ahead by the number of triggers is correct. Regular triggers are counted by the clock, others by
       the bursts in which bytes arrived, damaged ones included: a triggered sensor sends at once and is then silent.
    3. Other numbers are held, for at most three blocks. Two that agree in the sense of 1 and 2 are correct, and so are
       three successive ones, regardless of earlier numbers: the count recovers after any loss, and after a restart.
    4. A number between the last correct one and a later one is correct if the time between them has room for it.

    A repeated number is a copy. ``lost`` counts the numbers skipped between correct ones.
    """

    def __init__(self, *, shortest_s: float, expected: int | None = None) -> None:
        self.lost = 0
        self._shortest_ns = shortest_s * 1e9
        self._bursts = 0  # Before those in the list.
        self._burst_ns: list[int] = []  # Start of each burst since the last block.
        self._intervals_ns: deque[float] = deque(maxlen=_INTERVALS)
        self._held: list[_Entry] = []
        self._decided: list[tuple[Block, bool]] = []
        self._last: _Entry | None = None
        if expected is not None:
            self.expect(expected)

    @property
    def held(self) -> int:
        """Number of undecided blocks."""
        return len(self._held)

    def expect(self, counter: int) -> list[tuple[Block, bool]]:
        """Set the next number to ``counter`` or its successor; return the held blocks, none of which is correct."""
        self._reject_held()
        self._last = _Entry((counter - 1) % COUNTERS, 0.0, self._bursts + len(self._burst_ns))
        return self._results()

    def heard(self, at_ns: int) -> None:
        """Register that bytes arrived."""
        if not self._burst_ns or at_ns - self._burst_ns[-1] >= BURST * self._shortest_ns:
            self._burst_ns.append(at_ns)

    def judge(self, block: Block, rejected: float) -> list[tuple[Block, bool]]:
        """Return (block, correct) for all blocks that this one decides; rejected is in sizes of a block."""
        place = bisect.bisect_right(self._burst_ns, block.arrived.monotonic_ns) - 1
        self._bursts += max(place, 0)
        # All later bytes belong to this block, even if it is late.
        self._burst_ns = self._burst_ns[max(place, 0) :][:1]
        entry = _Entry(block.counter, rejected, self._bursts + 1, block)
        if self._last is None:
            self._accept(entry)
        elif self._last.block is not None and entry.counter == self._last.counter:
            self._decided.append((block, False))
        else:
            self._decide(entry, self._last)
        return self._results()

    def finish(self) -> list[tuple[Block, bool]]:
        """Decide the held blocks at the end of the stream: a number slightly ahead of the triggers is correct."""
        for entry in self._held:
            last = self._last
            if last is None or self._is_near(last, entry):
                self._accept(entry)
            else:
                self._reject(entry)
        self._held.clear()
        return self._results()

    def _results(self) -> list[tuple[Block, bool]]:
        decided, self._decided = self._decided, []
        return decided

    def _decide(self, entry: _Entry, last: _Entry) -> None:
        held = self._held
        before = held[-1] if held else last
        agreeing = [each for each in held if self._as_triggered(each, entry)][-1:]
        if _directly(before, entry):
            self._settle([before], entry)
            self._accept(entry)
        elif self._as_triggered(last, entry) or agreeing:
            if self._as_triggered(last, entry):
                # A stall may have split a burst, so that a held block seems too early; the clock is certain.
                agreeing = [each for each in agreeing if self._is_timed_between(last, each, entry)]
            self._settle(agreeing, entry)
            self._accept(entry)
        elif len(held) > 1 and _ahead(held[-2], before) == 1 == _ahead(before, entry):
            self._settle(held[-2:], entry)
            self._accept(entry)
        else:
            is_full = len(held) == _MAX_HELD
            if is_full:
                self._intervals_ns.clear()  # The triggers may have changed, so that the clock is wrong.
            if any(self._is_between(last, each, entry) for each in held):
                self._settle([], entry)
            elif is_full:
                unlikely = [each for each in held if not self._fits(last, each)]
                held.remove(worst := [*unlikely, *held][0])
                self._reject(worst)
            self._held.append(entry)

    def _settle(self, sure: list[_Entry], end: _Entry) -> None:
        """Decide held blocks: the ``sure`` ones are correct, and those that fit before them or before ``end``."""
        held, self._held = self._held, []
        for index, entry in enumerate(held):
            following = next((later for later in held[index:] if later in sure), end)
            if entry in sure or self._last is None or self._is_between(self._last, entry, following):
                self._accept(entry)
            else:
                self._reject(entry)

    def _accept(self, entry: _Entry) -> None:
        last, self._last = self._last, entry
        if entry.block is not None:
            self._decided.append((entry.block, True))
        if last is None or not self._is_advance(last, entry):
            return
        ahead = _ahead(last, entry)
        if last.block is None:  # A sensor that is set to n may count from n or from n + 1.
            self.lost += max(0, ahead - 1 - (ahead != entry.burst - last.burst))
        else:
            self.lost += ahead - 1
            self._intervals_ns.append(_elapsed_ns(last, entry) / ahead)

    def _reject(self, entry: _Entry) -> None:
        if entry.block is not None:
            self._decided.append((entry.block, False))

    def _reject_held(self) -> None:
        for entry in self._held:
            self._reject(entry)
        self._held.clear()

    def _as_triggered(self, first: _Entry, second: _Entry) -> bool:
        """Return True if numbers advanced by the number of triggers."""
        ahead = _ahead(first, second)
        if first.block is None:
            return 1 <= ahead <= 2 or 0 <= ahead - (second.burst - first.burst) <= 1
        return ahead == self._n_triggers(first, second)

    def _n_triggers(self, first: _Entry, second: _Entry) -> int:
        return self._by_clock(first, second) or max(1, second.burst - first.burst)

    def _by_clock(self, first: _Entry, second: _Entry) -> int | None:
        """Return the number of regular triggers, None if they are irregular or ambiguous."""
        if len(self._intervals_ns) < _INTERVALS:
            return None
        typical_ns = statistics.median(self._intervals_ns)
        n_alike = sum(abs(interval_ns - typical_ns) <= _REGULAR * typical_ns for interval_ns in self._intervals_ns)
        if n_alike < _ALIKE or typical_ns <= 0:
            return None
        passed = _elapsed_ns(first, second) / typical_ns
        count = round(passed)
        return count if 1 <= count <= _FAR and abs(passed - count) <= _NEAR else None

    def _is_timed_between(self, first: _Entry, second: _Entry, third: _Entry) -> bool:
        """Return True if a number lies between two correct ones, and the clock confirms its distance from the later."""
        ahead = _ahead(second, third)
        return ahead < _ahead(first, third) and self._by_clock(second, third) == ahead

    def _is_between(self, first: _Entry, second: _Entry, third: _Entry) -> bool:
        """Return True if a number lies between two correct ones, so that a missing one is plausible."""
        if _ahead(first, second) == 1 == _ahead(second, third):
            return True
        return self._fits(first, second) and self._fits(second, third)

    def _fits(self, first: _Entry, second: _Entry) -> bool:
        """Return True if nothing contradicts that two numbers are both correct."""
        return self._has_room(first, second) and self._by_clock(first, second) in {None, _ahead(first, second)}

    def _is_near(self, first: _Entry, second: _Entry) -> bool:
        """Return True for the next number, or if only a few triggers left no trace."""
        ahead = _ahead(first, second)
        if ahead == 1:
            return self._by_clock(first, second) in {None, 1}
        traces = max(self._n_triggers(first, second), second.rejected - first.rejected)
        return self._fits(first, second) and ahead - traces <= _UNHEARD

    def _has_room(self, first: _Entry, second: _Entry) -> bool:
        """Return True if that many triggers fit between two blocks, assuming that all bursts were received."""
        has_traces = first.block is None or second.burst - first.burst <= _ahead(first, second)
        return has_traces and self._is_advance(first, second)

    def _is_advance(self, first: _Entry, second: _Entry) -> bool:
        """Return True unless numbers advance by more triggers than the time has room for."""
        if first.block is None:
            most = float(max(1, second.burst - first.burst))
        else:
            most = max(_elapsed_ns(first, second) / self._shortest_ns, second.rejected - first.rejected)
        return 1 <= _ahead(first, second) <= _AHEAD + most


def _directly(first: _Entry, second: _Entry) -> bool:
    """Return True for the next number whose block follows directly."""
    return _ahead(first, second) == 1 and second.rejected == first.rejected and first.block is not None


def _ahead(first: _Entry, second: _Entry) -> int:
    return (second.counter - first.counter) % COUNTERS


def _elapsed_ns(first: _Entry, second: _Entry) -> int:
    if first.block is None or second.block is None:
        return 0
    return second.block.arrived.monotonic_ns - first.block.arrived.monotonic_ns
