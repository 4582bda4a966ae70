"""Assignment of blocks to pulses of the SYNC chain."""

import statistics
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

__all__ = ["PulseAligner", "SequenceState"]

Item = TypeVar("Item")

_PULSE_TOLERANCE = 0.4  # Relative to the interval between pulses: closer blocks belong to the same pulse.
_MAX_PULSES = 64  # Number of kept pulses, which span some seconds.
_MIN_VOTES = 3  # Number of blocks that decide an offset; a busy host or sensor may delay one.
_MAX_WAIT_S = 0.5  # Limit on the time that blocks wait for this decision.
_MIN_DISAGREEMENTS = 5  # Number of successive blocks that must contradict an offset before it changes.
_MAX_DISAGREEMENT_S = 5.0  # Limit on the time that these blocks wait.


@dataclass(slots=True)
class _HeldBlock(Generic[Item]):
    item: Item
    counter: int
    arrived_ns: int


@dataclass(slots=True)
class _SensorPulses(Generic[Item]):
    offset: int | None = None  # Offset from the sensor's own counter to the pulse number.
    held: list[_HeldBlock[Item]] = field(default_factory=list)


class PulseAligner(Generic[Item]):
    """Assignment of pulse numbers to the blocks of several sensors.

    Each sensor counts its own triggers. The counters differ by an offset, because sensors are armed one after the other
    and an unplugged or busy sensor misses pulses. The times of arrival give the offsets: chained sensors measure within
    microseconds, and pulses are at least 50 ms apart. A block may arrive late, so the majority of three blocks decides.
    The offset then stays, until the times of five successive blocks contradict it. The first sensor receives all
    pulses.
    """

    def __init__(self, sensors: list[str], *, shortest_s: float) -> None:
        self._sensors: dict[str, _SensorPulses[Item]] = {name: _SensorPulses() for name in sensors}
        self._first = sensors[0]
        self._shortest_ns = round(shortest_s * 1e9)
        self._pulses: dict[int, int] = {}  # Time of the first block, by pulse number.
        self._intervals_ns: deque[float] = deque(maxlen=_MAX_PULSES)
        self.realigned = 0
        self.interval_ns = float(self._shortest_ns)

    def reset(self, sensor: str) -> list[tuple[Item, int]]:
        """Align a sensor again, after it has missed pulses or restarted its counter; return its held blocks."""
        state = self._sensors[sensor]
        found: list[tuple[Item, int]] = []
        if state.held and self._is_offset_known(sensor, state, state.held[-1].arrived_ns, at_once=True):
            found = self._release_held(state)
        state.offset = None
        return found

    def add(self, sensor: str, item: Item, counter: int, arrived_ns: int) -> list[tuple[Item, int]]:
        """Add a block by its unwrapped counter and monotonic time; return blocks with known pulse numbers."""
        self._sensors[sensor].held.append(_HeldBlock(item, counter, arrived_ns))
        return self.release(arrived_ns)

    def release(self, now_ns: int, *, at_once: bool = False) -> list[tuple[Item, int]]:
        """Return blocks that need not wait any longer; with ``at_once`` all of them, with their most likely numbers."""
        found: list[tuple[Item, int]] = []
        progress = True
        while progress:  # A block of one sensor may resolve that of another.
            progress = False
            for name, state in self._sensors.items():
                if not state.held or not self._is_offset_known(name, state, now_ns, at_once=at_once):
                    continue
                progress = True
                found += self._release_held(state)
        return found

    def _release_held(self, state: _SensorPulses[Item]) -> list[tuple[Item, int]]:
        found = []
        for each in state.held:
            number = each.counter + (state.offset or 0)
            self._note(number, each.arrived_ns)
            found.append((each.item, number))
        state.held = []
        return found

    def _is_offset_known(self, name: str, state: _SensorPulses[Item], now_ns: int, *, at_once: bool) -> bool:
        """Determine the offset of a sensor with held blocks; return True if it is now known."""
        waited = at_once or now_ns - state.held[0].arrived_ns > _MAX_WAIT_S * 1e9
        if not self._pulses:
            if name == self._first or waited:
                state.offset = -state.held[0].counter  # The first pulse is number 0.
            return state.offset is not None
        if state.offset is not None:
            doubted_s = (now_ns - state.held[0].arrived_ns) / 1e9
            if self._agrees(state.held[-1], state.offset) or at_once or doubted_s > _MAX_DISAGREEMENT_S:
                return True
            if len(state.held) < _MIN_DISAGREEMENTS:
                return False
        elif len(state.held) < _MIN_VOTES and not waited and not self._is_alone:
            return False
        if not self._intervals_ns and not waited:
            return False  # The tolerance is not known yet.
        voted = self._majority_offset(state.held, waited=waited)
        if voted is not None:
            self.realigned += state.offset not in {None, voted}
            state.offset = voted
        return state.offset is not None

    @property
    def _is_alone(self) -> bool:
        """Return True if there is no other sensor to compare with."""
        return len(self._sensors) == 1

    def _majority_offset(self, held: list[_HeldBlock[Item]], *, waited: bool) -> int | None:
        """Return the offset that most times of arrival support, None while there is no majority."""
        votes = Counter(
            number - each.counter
            for each in held
            if (number := self._number(each.arrived_ns, waited=waited)) is not None
        )
        if not votes:
            return None
        offset, count = votes.most_common(1)[0]
        return offset if waited or 2 * count > len(held) else None

    def _number(self, arrived_ns: int, *, waited: bool) -> int | None:
        """Return the pulse number that a time of arrival indicates, None while it is unknown."""
        number = min(self._pulses, key=lambda each: abs(self._pulses[each] - arrived_ns))
        away_ns = arrived_ns - self._pulses[number]
        if abs(away_ns) <= _PULSE_TOLERANCE * self.interval_ns:
            return number
        earlier = [each for each, time_ns in self._pulses.items() if time_ns <= arrived_ns]
        later = [each for each, time_ns in self._pulses.items() if time_ns > arrived_ns]
        if earlier and later:  # Other sensors have delivered pulses before and after it only.
            return self._between(max(earlier), min(later), arrived_ns)
        if later or waited or self._is_alone or all(state.offset is None for state in self._sensors.values()):
            return number + round(away_ns / self.interval_ns)  # The interval gives the number.
        return None

    def _between(self, first: int, last: int, time_ns: int) -> int:
        share = (time_ns - self._pulses[first]) / (self._pulses[last] - self._pulses[first])
        if last - first < 2:
            return first if share < 1 / 2 else last
        return min(max(first + round(share * (last - first)), first + 1), last - 1)

    def _agrees(self, held: _HeldBlock[Item], offset: int) -> bool:
        """Return True unless another block of the same pulse contradicts an offset by its time."""
        known_ns = self._pulses.get(held.counter + offset)
        return known_ns is None or abs(held.arrived_ns - known_ns) <= self.interval_ns / 2

    def _note(self, number: int, arrived_ns: int) -> None:
        if number in self._pulses:
            self._pulses[number] = min(self._pulses[number], arrived_ns)
            return
        before_ns = self._pulses.get(number - 1)
        if before_ns is not None and arrived_ns > before_ns:
            self._intervals_ns.append(arrived_ns - before_ns)
            self.interval_ns = statistics.median(self._intervals_ns)
        self._pulses[number] = arrived_ns
        while len(self._pulses) > _MAX_PULSES:
            del self._pulses[min(self._pulses)]


@dataclass(slots=True)
class SequenceState:
    """Sequence numbers of one sensor."""

    sequence: int | None = None  # Number of the latest measurement, stored or missing.
    first_pulse: int | None = None
    tick: int = -1  # Number of the latest command.
    why: str = ""  # Reason for missing measurements, if known.
    passed: bool = False  # True once a pulse beyond the last requested one has arrived.
