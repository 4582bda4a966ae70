"""Groups of images, clouds or measurements of the same SYNC pulse."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Generic, Protocol, TypeVar

from ertis_numba.frames import Stamp

__all__ = ["PulseGroups", "is_same_pulse"]

_SAME_PULSE_NS: Final = 500_000_000  # Counts of different captures may be equal by accident.


class _Stamped(Protocol):
    @property
    def stamp(self) -> Stamp: ...


Item = TypeVar("Item", bound=_Stamped)


def is_same_pulse(one: Stamp, other: Stamp) -> bool:
    """Return True for measurements of one SYNC pulse: equal counts at about the same time."""
    return one.sync_count == other.sync_count and abs(one.timestamp_ns - other.timestamp_ns) < _SAME_PULSE_NS


@dataclass(slots=True)
class PulseGroups(Generic[Item]):
    """Collector of one item per sensor for each SYNC pulse.

    A group is complete once it has items of all sensors of the two groups before, and of sensors that have come since.
    Of a sensor that is missing, the next group shows that no more will come.
    """

    _expected: set[str] = field(default_factory=set)
    _previous: set[str] = field(default_factory=set)
    _group: dict[str, Item] = field(default_factory=dict)
    _closed: Stamp | None = None  # Stamp of the group that was returned last.

    @classmethod
    def of(cls, sensors: Iterable[str]) -> "PulseGroups[Item]":
        """Return a collector that waits for these sensors at first."""
        return cls(set(sensors), set(sensors))

    def add(self, item: Item) -> list[dict[str, Item]]:
        """Add an item, and return the groups that are complete now, by sensor.

        Items that come after their group was returned are left out.
        """
        done = []
        if self._group and not self._belongs(item):
            done.append(self.close())
        sensor = item.stamp.sensor
        is_late = self._closed is not None and is_same_pulse(item.stamp, self._closed) and not self._group
        self._expected.add(sensor)
        if not is_late:
            self._group[sensor] = item
            if self._group.keys() >= self._expected:
                done.append(self.close())
        return done

    def close(self) -> dict[str, Item]:
        """Return the open group, complete or not; empty if there is none."""
        group, self._group = self._group, {}
        if group:
            self._expected, self._previous = self._previous | group.keys(), set(group)
            self._closed = next(iter(group.values())).stamp
        return group

    def _belongs(self, item: Item) -> bool:
        other = next(iter(self._group.values())).stamp
        return item.stamp.sensor not in self._group and is_same_pulse(item.stamp, other)
