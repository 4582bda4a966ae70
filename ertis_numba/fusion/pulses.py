"""Groups of images, clouds or measurements of the same SYNC pulse."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from ertis_numba.frames import Stamp

__all__ = ["PulseGroups", "is_same_pulse"]

_SAME_PULSE_NS: Final = 500_000_000  # Counts of different captures may be equal by accident.
_MAX_LATER: Final = 3  # Pulses after one that is not complete.
_WRONG_CLOCK_NS: Final = 1_000_000_000  # Times that contradict the arrivals by more than this are wrong.
_LATE_NS: Final = 1_000_000_000  # Time of nothing but late items after which a sensor begins anew …
_MIN_LATE: Final = 3  # … and their least number.
_MAX_SESSIONS: Final = 256


class _Stamped(Protocol):
    @property
    def stamp(self) -> Stamp: ...


Item = TypeVar("Item", bound=_Stamped)


def is_same_pulse(one: Stamp, other: Stamp) -> bool:
    """Return True for measurements of one SYNC pulse: equal counts of one session, or at about the same time."""
    return one.sync_count == other.sync_count and (
        one.session_id == other.session_id != 0 or abs(one.timestamp_ns - other.timestamp_ns) < _SAME_PULSE_NS
    )


class _PulsePlace(NamedTuple):
    """Place of an item in the order of the pulses: by SYNC count within a session, by time between sessions."""

    stamp: Stamp
    session: tuple[int, int]  # Number of the session, and how often it has begun anew.
    arrived_ns: int

    def shares_session(self, other: "_PulsePlace") -> bool:
        return self.session == other.session and self.session[0] != 0

    def is_same_pulse(self, other: "_PulsePlace") -> bool:
        if self.shares_session(other):
            return self.stamp.sync_count == other.stamp.sync_count
        apart_ns = self.stamp.timestamp_ns - other.stamp.timestamp_ns
        return self.stamp.sync_count == other.stamp.sync_count and abs(apart_ns) < _SAME_PULSE_NS

    def is_earlier(self, other: "_PulsePlace") -> bool:
        """Return True if this pulse came first. Clocks of sessions may differ by more than a period of SYNC."""
        apart_ns = self.stamp.timestamp_ns - other.stamp.timestamp_ns
        if self.shares_session(other) or abs(apart_ns) < _SAME_PULSE_NS:
            return self.stamp.sync_count < other.stamp.sync_count
        came_ns = self.arrived_ns - other.arrived_ns
        # Items arrive soon after their emission. If the clocks contradict the arrivals, a clock is wrong.
        return came_ns < 0 if abs(apart_ns - came_ns) > _WRONG_CLOCK_NS and came_ns else apart_ns < 0


@dataclass(slots=True)
class _OpenPulse(Generic[Item]):
    items: dict[str, Item]
    places: list[_PulsePlace]


@dataclass(slots=True)
class _Lateness:
    since_ns: int
    count: int = 0


@dataclass(slots=True)
class PulseGroups(Generic[Item]):
    """Collector of one item per sensor for each SYNC pulse, in the order of the pulses.

    A group is complete once it has items of all sensors of the two groups before, and of sensors that have come since.
    Images of different sensors may overtake each other, so a group stays open while the next one begins. It ends
    without a sensor that has an item of a later pulse, or that was missing from the two groups before, and at the
    latest when three later groups have begun.
    Items of a session are ordered by their SYNC count, so that a clock may be wrong or be set. Times order only the
    items of different sessions, unless they contradict the arrivals by more than a second. If all items of a sensor are
    late for a second, its counter has begun anew, and so does its grouping.
    """

    on_note: Callable[[str], None] = lambda _: None
    now_ns: Callable[[], int] = time.monotonic_ns
    _expected: set[str] = field(default_factory=set)
    _recent: deque[set[str]] = field(default_factory=lambda: deque(maxlen=2))  # Sensors of the groups returned last.
    _open: list[_OpenPulse[Item]] = field(default_factory=list)
    _waits: bool = False  # Until the second pulse begins.
    _closed: list[_PulsePlace] = field(default_factory=list)  # Places of the group that was returned last.
    _counts: dict[tuple[int, int], int] = field(default_factory=dict)  # Last count that was returned, by session.
    _restarts: Counter[str] = field(default_factory=Counter)  # By sensor.
    _late: dict[str, _Lateness] = field(default_factory=dict)  # Sensors whose last items were late.

    @classmethod
    def of(cls, sensors: Iterable[str], on_note: Callable[[str], None] = lambda _: None) -> "PulseGroups[Item]":
        """Return a collector that waits for these sensors at first; without any, until the second pulse begins."""
        found = cls(on_note, _expected=set(sensors))
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
            found._insert(item, _PulsePlace(item.stamp, (0, 0), item.stamp.timestamp_ns))
        return [group.items for group in found._open]

    def add(self, item: Item) -> list[dict[str, Item]]:
        """Add an item, and return the groups that are complete now, by sensor; items after their group are left out."""
        sensor = item.stamp.sensor
        self._expected.add(sensor)
        place = self._place(item.stamp)
        if self._is_late(place):
            if not self._begins_anew(place):
                return []
            place = self._place(item.stamp)
        self._late.pop(sensor, None)
        self._insert(item, place)
        done = []
        while self._open and self._is_done():
            done.append(self.close())
        return done

    def close(self) -> dict[str, Item]:
        """Return the earliest open group, complete or not; empty if there is none."""
        if not self._open:
            return {}
        group = self._open.pop(0)
        self._recent.append(set(group.items))
        self._expected = set().union(*self._recent, *(each.items for each in self._open))
        self._closed = group.places
        for place in group.places:
            self._counts.pop(place.session, None)  # The latest ones stay.
            self._counts[place.session] = place.stamp.sync_count
        while len(self._counts) > _MAX_SESSIONS:
            del self._counts[next(iter(self._counts))]
        return group.items

    def _place(self, stamp: Stamp) -> _PulsePlace:
        return _PulsePlace(stamp, (stamp.session_id, self._restarts[stamp.sensor]), self.now_ns())

    def _is_late(self, place: _PulsePlace) -> bool:
        if place.session[0] and place.session in self._counts:
            if place.stamp.sync_count <= self._counts[place.session]:
                return True
            if any(place.shares_session(closed) for closed in self._closed):
                return False
        restarted = self._restarts[place.stamp.sensor] and place.session not in self._counts
        return not restarted and any(place.is_same_pulse(each) or place.is_earlier(each) for each in self._closed)

    def _begins_anew(self, place: _PulsePlace) -> bool:
        """Return True, and let the session of a sensor begin anew, if its items have been late for a second."""
        sensor = place.stamp.sensor
        late = self._late.setdefault(sensor, _Lateness(place.arrived_ns))
        late.count += 1
        if late.count < _MIN_LATE or place.arrived_ns - late.since_ns < _LATE_NS:
            return False
        self._restarts[sensor] += 1
        self.on_note(
            f"images of sensor {sensor} were left out for {(place.arrived_ns - late.since_ns) / 1e9:.1f} s, because "
            f"their SYNC counts or times went back; its pulses count anew from {place.stamp.sync_count}"
        )
        return True

    def _insert(self, item: Item, place: _PulsePlace) -> None:
        """Add an item to the group of its pulse, or to a new one in the order of the pulses."""
        number = len(self._open)
        while number and not self._open[number - 1].places[0].is_earlier(place):
            number -= 1
            group = self._open[number]
            if item.stamp.sensor not in group.items and any(place.is_same_pulse(each) for each in group.places):
                group.items[item.stamp.sensor] = item
                group.places.append(place)
                return
        self._open.insert(number, _OpenPulse({item.stamp.sensor: item}, [place]))

    def _is_done(self) -> bool:
        """Return True if no item of the earliest group can be expected any more."""
        first, *later = (group.items for group in self._open)
        missing = self._expected - first.keys()
        if later:
            seen, active = set().union(*later), set().union(*self._recent)
            missing = (missing & active) - seen
        elif self._waits and not self._recent:
            return False
        return not missing or len(later) == _MAX_LATER
