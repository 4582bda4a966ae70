"""Rows of a journal, as a recording would contain them."""

from collections.abc import Iterator
from dataclasses import dataclass

from ertis_numba.base.errors import DamagedError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import Journal, JournalEntry
from ertis_numba.storage._gaps import SensorSequences

__all__ = ["DamagedMeasurement", "JournalRows", "damaged_poses"]

_DAMAGED = "damaged in the journal"


@dataclass(frozen=True, slots=True)
class DamagedMeasurement:
    """Unreadable measurement: its index among those of its sensor, its number, and the damage."""

    index: int
    sequence: int
    reason: str


def damaged_poses(count: int) -> str:
    """Return a message about damaged poses; empty if there are none."""
    return "" if not count else "1 pose is damaged" if count == 1 else f"{count} poses are damaged"


class JournalRows:
    """Undamaged measurements of one sensor of a journal; once all are read, ``keys`` also have damaged ones."""

    def __init__(self, journal: Journal, sensor: str) -> None:
        self._journal, self._sensor = journal, sensor
        self.keys = journal.index(sensor)
        self._noted = [gap for gap in journal.gaps if gap.sensor == sensor]
        self._numbers = SensorSequences()
        self.damaged: list[DamagedMeasurement] = []

    def __len__(self) -> int:
        """Return the number of measurements, damaged ones included."""
        return len(self.keys)

    def __iter__(self) -> Iterator[JournalEntry]:
        self._numbers, self.damaged = SensorSequences(), []
        for index, key in enumerate(self.keys):
            try:
                entry = self._journal.entry(key)
            except DamagedError as error:  # Other errors may be temporary, so they are raised.
                self.damaged.append(DamagedMeasurement(index, key.sequence, str(error)))
                continue
            self._numbers.add(key.sequence, key.session_id)
            yield entry

    @property
    def missing(self) -> list[SequenceGap]:
        """Missing numbers in order, damaged ones included."""
        keys = (self.keys[item.index] for item in self.damaged)
        lost = [
            SequenceGap(key.sensor, key.sequence, key.sequence, _DAMAGED, key.session_id)
            for key in keys
            if min(key.sequence, key.session_id) >= 0  # A negative number is itself damaged, and names no gap.
        ]
        return self._numbers.missing(self._sensor, [*lost, *self._noted])
