"""Dead-letter queue of measurements that made workers fail, for later analysis."""

import queue
import threading
import zlib
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.journal import SUFFIX, Journal, JournalEntry
from ertis_numba.network.log import EventLog
from ertis_numba.network.processing.runner import Job, bytes_of
from ertis_numba.settings import Settings

__all__ = ["DeadLetterQueue", "entry_of"]

_WAITING: Final = 16
_MAX: Final = 100  # Limit on kept measurements: a fault of one sensor must not fill a disk.
_CLOSED_S: Final = 2.0


class DeadLetterQueue:
    """Writer of measurements into a journal in a thread, for ``ertis import journals``; a slow disk delays nothing."""

    def __init__(self, folder: Path, log: EventLog) -> None:
        self._folder, self._log = folder, log
        self._waiting: queue.Queue[JournalEntry | None] = queue.Queue(_WAITING)
        self._thread = threading.Thread(target=self._run, name="quarantine", daemon=True)
        self._journal: Journal | None = None
        self._kept = 0
        self._thread.start()

    def put(self, entry: JournalEntry) -> None:
        """Queue a measurement, unless too many are kept or the disk is far behind."""
        if self._kept >= _MAX:
            self._lost(entry, f"{_MAX} measurements are kept already; analyse these first")
            return
        self._kept += 1
        try:
            self._waiting.put_nowait(entry)
        except queue.Full:
            self._lost(entry, "the disk is too slow")

    def close(self) -> None:
        """Write the waiting measurements and close; a disk that does not answer is not waited for."""
        with suppress(queue.Full):
            self._waiting.put(None, timeout=_CLOSED_S)
        self._thread.join(_CLOSED_S)

    def _lost(self, entry: JournalEntry, why: str) -> None:
        stamp = entry.measurement.stamp
        self._log.error("not_kept", sensor=stamp.sensor, session_id=stamp.session_id, sequence=stamp.sequence, text=why)

    def _run(self) -> None:
        while (entry := self._waiting.get()) is not None:
            try:
                self._write(entry)
            except (OSError, ValueError) as error:
                self._lost(entry, str(error))
        if self._journal is not None:
            self._journal.close()

    def _write(self, entry: JournalEntry) -> None:
        measurement: Measurement = entry.measurement
        if self._journal is not None:
            try:
                self._append(self._journal, measurement, entry)
            except ArgumentError:  # Numbers that do not rise, or other settings, need another journal.
                self._journal.close()
                self._journal = None
            else:
                return
        target = self._folder / f"quarantine_{datetime.now(UTC):%Y%m%dT%H%M%S_%fZ}.h5"
        self._journal = Journal.create(target.with_name(target.name + SUFFIX), target=target.name, source="quarantine")
        self._append(self._journal, measurement, entry)
        self._log.warning(
            "quarantine", text=f"recover the kept measurements with 'ertis import journals {self._journal.path}'"
        )

    @staticmethod
    def _append(journal: Journal, measurement: Measurement, entry: JournalEntry) -> None:
        if measurement.stamp.sensor not in journal.sensors:
            journal.add_sensor(measurement.stamp.sensor, measurement.settings)
        journal.append([entry])


def entry_of(job: Job, settings: Settings) -> JournalEntry | None:
    """Return the measurement of a job with the settings of its sensor; None if its data does not match them."""
    data, content = job.data, bytes_of(job.words)
    words = sample_format(settings)
    if len(content) != words.n_bytes:
        return None
    measurement = Measurement(words.from_bytes(content).copy(), settings.replace(air=data.air), data.stamp)
    return JournalEntry(measurement, data.monotonic_ns, zlib.crc32(content))
