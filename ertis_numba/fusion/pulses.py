"""Groups of images, clouds or measurements of the same SYNC pulse."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Generic, Protocol, TypeVar

from ertis_numba.frames import Stamp

__all__ = ["PulseGroups", "is_same_pulse"]

_SAME_PULSE_NS: Final = 500_000_000  # Counts of different captures may be equal by accident.
_MAX_LATER: Final = 3  # Pulses after one that is not complete.


class _Stamped(Protocol):
    @property
    def stamp(self) -> Stamp: ...


Item = TypeVar("Item", bound=_Stamped)


def is_same_pulse(one: Stamp, other: Stamp) -> bool:
    """Return True for measurements of one SYNC pulse: equal counts at about the same time."""
    return one.sync_count == other.sync_count and abs(one.timestamp_ns - other.timestamp_ns) < _SAME_PULSE_NS


def _is_earlier(one: Stamp, other: Stamp) -> bool:
    """Return True if the pulse of ``one`` came first. Clocks of sensors may differ by more than a period of SYNC."""
    apart_ns = one.timestamp_ns - other.timestamp_ns
    return one.sync_count < other.sync_count if abs(apart_ns) < _SAME_PULSE_NS else apart_ns < 0


@dataclass(slots=True)
class PulseGroups(Generic[Item]):
    """Collector of one item per sensor for each SYNC pulse, in the order of the pulses.

    A group is complete once it has items of all sensors of the two groups before, and of sensors that have come since.
    Images of different sensors may overtake each other, so a group stays open while the next one begins. It ends
    without a sensor that has an item of a later pulse, or that was missing from the two groups before, and at the
    latest when three later groups have begun.
    """

    _expected: set[str] = field(default_factory=set)
    _recent: deque[set[str]] = field(default_factory=lambda: deque(maxlen=2))  # Sensors of the groups returned last.
    _open: list[dict[str, Item]] = field(default_factory=list)
    _waits: bool = False  # Until the second pulse begins.
    _closed: Stamp | None = None  # Stamp of the group that was returned last.

    @classmethod
    def of(cls, sensors: Iterable[str]) -> "PulseGroups[Item]":
        """Return a collector that waits for these sensors at first; without any, until the second pulse begins."""
        found = cls(set(sensors))
        if not found._expected:
            found._waits = True
            return found
        found._recent.append(set(found._expected))
        return found

    @classmethod
    def recorded(cls, items: Iterable[Item]) -> list[dict[str, Item]]:
        """Return the groups of all items of recordings, in any order; none of them is late."""
        found = cls()
        for item in sorted(items, key=lambda item: (item.stamp.timestamp_ns, item.stamp.sync_count)):
            found._insert(item)
        return found._open

    def add(self, item: Item) -> list[dict[str, Item]]:
        """Add an item, and return the groups that are complete now, by sensor.

        Items that come after their group was returned are left out.
        """
        self._expected.add(item.stamp.sensor)
        if not self._is_late(item.stamp):
            self._insert(item)
        done = []
        while self._open and self._is_done():
            done.append(self.close())
        return done

    def close(self) -> dict[str, Item]:
        """Return the earliest open group, complete or not; empty if there is none."""
        if not self._open:
            return {}
        group = self._open.pop(0)
        self._recent.append(set(group))
        self._expected = set().union(*self._recent, *self._open)
        self._closed = _stamp(group)
        return group

    def _is_late(self, stamp: Stamp) -> bool:
        return self._closed is not None and (is_same_pulse(stamp, self._closed) or _is_earlier(stamp, self._closed))

    def _insert(self, item: Item) -> None:
        """Add an item to the group of its pulse, or to a new one in the order of the pulses."""
        place = len(self._open)
        while place and not _is_earlier(_stamp(self._open[place - 1]), item.stamp):
            place -= 1
            group = self._open[place]
            if item.stamp.sensor not in group and is_same_pulse(item.stamp, _stamp(group)):
                group[item.stamp.sensor] = item
                return
        self._open.insert(place, {item.stamp.sensor: item})

    def _is_done(self) -> bool:
        """Return True if no item of the earliest group can be expected any more."""
        first, *later = self._open
        missing = self._expected - first.keys()
        if later:
            seen, active = set().union(*later), set().union(*self._recent)
            missing = (missing & active) - seen
        elif self._waits and not self._recent:
            return False
        return not missing or len(later) == _MAX_LATER


def _stamp(group: "dict[str, Item]") -> Stamp:
    return next(iter(group.values())).stamp
