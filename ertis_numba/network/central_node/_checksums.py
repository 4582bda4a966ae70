"""CRC-32 of stored measurements, to compare a measurement that arrives again with the stored one."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from typing import Final

from ertis_numba.journal import Journal
from ertis_numba.network.central_node._received_items import SensorSession

__all__ = ["Checksums"]

_KEPT: Final = 65_536  # Takes about 15 MB.
_LEARNED: Final = 1024  # Number of newest measurements of a journal left by a crash.
_TAIL: Final = 16  # Per session: the largest window of a sensor node.


class Checksums:
    """CRC-32 of the newest measurements by session and number.

    Parameters
    ----------
    tails : mapping of SensorSession to dict of int to int
        CRC-32 by session and number, from earlier processes.
    """

    def __init__(self, tails: Mapping[SensorSession, Mapping[int, int]]) -> None:
        self._kept: OrderedDict[tuple[SensorSession, int], int] = OrderedDict()
        for run, numbers in tails.items():
            for number, crc32 in numbers.items():
                self._kept[run, number] = crc32

    def find(self, run: SensorSession, number: int) -> int | None:
        """Return the CRC-32 of a measurement; None if it is not kept."""
        return self._kept.get((run, number))

    def add(self, run: SensorSession, number: int, crc32: int) -> None:
        """Keep the CRC-32 of a measurement that is stored."""
        self._kept[run, number] = crc32
        if len(self._kept) > _KEPT:
            self._kept.popitem(last=False)

    def learn(self, journal: Journal) -> None:
        """Keep the CRC-32 of the newest measurements of a journal."""
        for sensor, session_id, number, crc32 in journal.newest(_LEARNED):
            self.add(SensorSession(sensor, session_id), number, crc32)

    def tails(self, runs: Iterable[SensorSession]) -> dict[SensorSession, dict[int, int]]:
        """Return the CRC-32 of the newest measurements of given sessions, for the next process."""
        found: dict[SensorSession, dict[int, int]] = {run: {} for run in runs}
        for (run, number), crc32 in reversed(self._kept.items()):
            if run in found and len(found[run]) < _TAIL:
                found[run][number] = crc32
        return {run: dict(sorted(numbers.items())) for run, numbers in found.items() if numbers}
