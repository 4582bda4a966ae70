"""A journal as a recording would hold it."""

from collections.abc import Iterator
from dataclasses import dataclass

from ertis_numba.errors import DamagedError
from ertis_numba.journal import Entry, Journal
from ertis_numba.storage._gaps import Missing, Runs

__all__ = ["Damage", "JournalRows"]

_DAMAGED = "damaged in the journal"


@dataclass(frozen=True, slots=True)
class Damage:
    """A measurement that cannot be read: its place among those of its sensor, its number, and what is wrong."""

    index: int
    sequence: int
    reason: str


class JournalRows:
    """The measurements of one sensor of a journal, without those that are damaged.

    What it says beside them counts once all have been read.

    Attributes
    ----------
    keys : list of Key
    damaged : list of Damage
    """

    def __init__(self, journal: Journal, sensor: str) -> None:
        self._journal = journal
        self.keys = journal.index(sensor)
        self._noted = [
            Missing(gap.first, gap.last, gap.reason, gap.session_id) for gap in journal.gaps if gap.sensor == sensor
        ]
        self._numbers = Runs()
        self.damaged: list[Damage] = []

    def __len__(self) -> int:
        """Return how many there are, with those that are damaged."""
        return len(self.keys)

    def __iter__(self) -> Iterator[Entry]:
        self._numbers, self.damaged = Runs(), []
        for index, key in enumerate(self.keys):
            try:
                entry = self._journal.entry(key)
            except DamagedError as error:  # others may pass: nothing is lost yet
                self.damaged.append(Damage(index, key.sequence, str(error)))
                continue
            self._numbers.add(key.sequence, key.session_id)
            yield entry

    @property
    def missing(self) -> list[Missing]:
        """What is missing, in order; with what is damaged."""
        lost = [
            Missing(item.sequence, item.sequence, _DAMAGED, self.keys[item.index].session_id) for item in self.damaged
        ]
        return self._numbers.missing([*lost, *self._noted])
