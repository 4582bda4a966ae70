"""Which pulse of the SYNC chain a block belongs to."""

import statistics
from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

__all__ = ["SyncCounts"]

Item = TypeVar("Item")

_NEAR = 0.4  # of the interval between pulses: what arrives within it is of the same pulse
_PULSES = 64  # that are remembered: some seconds
_HELD_S = 0.5  # that a block waits for one of another sensor to compare it with


@dataclass(slots=True)
class _Held(Generic[Item]):
    item: Item
    counter: int
    arrived_ns: int


@dataclass(slots=True)
class _Sensor(Generic[Item]):
    offset: int | None = None  # from the sensor's own counter to the pulse's number
    held: list[_Held[Item]] = field(default_factory=list)


class SyncCounts(Generic[Item]):
    """Gives blocks of several sensors the number of the pulse that triggered them.

    Each sensor counts its own triggers. The counters agree but for an offset, as the sensors are armed one after the
    other, and one that was unplugged has missed pulses. Offsets are found by the times at which blocks arrived: chained
    sensors measure within microseconds, pulses are 50 ms or more apart. From then on the counter decides, and times
    only watch over it.

    Parameters
    ----------
    sensors : list of str
        In the order in which they are armed: the first one hears every pulse that any other hears.
    shortest_s : float
        Least interval between pulses.

    Attributes
    ----------
    realigned : int
        How often a sensor's counter disagreed with the times of the others and was compared anew.
    """

    def __init__(self, sensors: list[str], *, shortest_s: float) -> None:
        self._sensors: dict[str, _Sensor[Item]] = {name: _Sensor() for name in sensors}
        self._first = sensors[0]
        self._shortest_ns = round(shortest_s * 1e9)
        self._pulses: dict[int, int] = {}  # number: time of its first block
        self._intervals_ns: deque[float] = deque(maxlen=_PULSES)
        self.realigned = 0

    def forget(self, sensor: str) -> None:
        """Compare a sensor anew: its counter has started again."""
        self._sensors[sensor].offset = None

    def add(self, sensor: str, item: Item, counter: int, arrived_ns: int) -> list[tuple[Item, int]]:
        """Take a block and return those whose pulse is known now, with its number.

        Parameters
        ----------
        sensor : str
        item : object
            Whatever is to be returned.
        counter : int
            The sensor's own, without wrap-around.
        arrived_ns : int
            By a clock that never steps.
        """
        state = self._sensors[sensor]
        if state.offset is not None and not self._agrees(counter + state.offset, arrived_ns):
            state.offset = None
            self.realigned += 1
        state.held.append(_Held(item, counter, arrived_ns))
        return self.release(arrived_ns)

    def release(self, now_ns: int, *, at_once: bool = False) -> list[tuple[Item, int]]:
        """Return what need not wait any longer; with ``at_once`` everything, by the best guess there is."""
        found: list[tuple[Item, int]] = []
        progress = True
        while progress:  # one sensor's block may be what another one waited for
            progress = False
            for name, state in self._sensors.items():
                if state.offset is None and state.held:
                    state.offset = self._offset(name, state.held[0], now_ns, at_once=at_once)
                if state.offset is None or not state.held:
                    continue
                progress = True
                for each in state.held:
                    number = each.counter + state.offset
                    self._note(number, each.arrived_ns)
                    found.append((each.item, number))
                state.held = []
        return found

    @property
    def interval_ns(self) -> float:
        """Time between pulses, the shortest possible while it is not known."""
        return statistics.median(self._intervals_ns) if self._intervals_ns else float(self._shortest_ns)

    def _offset(self, name: str, held: _Held[Item], now_ns: int, *, at_once: bool) -> int | None:
        """Return the offset of a sensor by the time of its oldest block, None while it is too early to say."""
        waited = at_once or now_ns - held.arrived_ns > _HELD_S * 1e9
        if not self._pulses:
            return -held.counter if name == self._first or waited else None  # the first pulse is number 0
        if not self._intervals_ns and not waited:
            return None  # how near is near, is not known yet
        number = min(self._pulses, key=lambda each: abs(self._pulses[each] - held.arrived_ns))
        away_ns = held.arrived_ns - self._pulses[number]
        if abs(away_ns) <= _NEAR * self.interval_ns:
            return number - held.counter
        earlier = [each for each, time_ns in self._pulses.items() if time_ns <= held.arrived_ns]
        later = [each for each, time_ns in self._pulses.items() if time_ns > held.arrived_ns]
        alone = all(state.offset is None for state in self._sensors.values())
        if earlier and later:  # a pulse that no other sensor has delivered, between two that one has
            return self._between(max(earlier), min(later), held.arrived_ns) - held.counter
        if later or waited or alone:  # counted by the interval
            return number + round(away_ns / self.interval_ns) - held.counter
        return None

    def _between(self, first: int, last: int, time_ns: int) -> int:
        share = (time_ns - self._pulses[first]) / (self._pulses[last] - self._pulses[first])
        if last - first < 2:
            return first if share < 1 / 2 else last
        return min(max(first + round(share * (last - first)), first + 1), last - 1)

    def _agrees(self, number: int, arrived_ns: int) -> bool:
        """Whether no other sensor's time speaks against a number."""
        known_ns = self._pulses.get(number)
        return known_ns is None or abs(arrived_ns - known_ns) <= max(self.interval_ns, self._shortest_ns) / 2

    def _note(self, number: int, arrived_ns: int) -> None:
        if number in self._pulses:
            return
        before_ns = self._pulses.get(number - 1)
        if before_ns is not None and arrived_ns > before_ns:
            self._intervals_ns.append(arrived_ns - before_ns)
        self._pulses[number] = arrived_ns
        while len(self._pulses) > _PULSES:
            del self._pulses[min(self._pulses)]
