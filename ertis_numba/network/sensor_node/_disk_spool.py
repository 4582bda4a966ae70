"""Spool on disk: a journal for each session, cleared as the central node acknowledges."""

import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Final, Literal

from ertis_numba.base import checks
from ertis_numba.base.atomic_files import make_folder
from ertis_numba.base.errors import DamagedError, DataError, JournalInUseError, NetworkError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import LOST, SUFFIX, Journal, JournalEntry
from ertis_numba.network.messages import MAX_SEQUENCE
from ertis_numba.network.sensor_node._memory_spool import SensorCounts, Spool
from ertis_numba.network.sensor_node._outgoing_sessions import OutgoingSession, UnackedItem

__all__ = ["DAMAGED", "SPOOL_FULL", "DiskSpool"]

SPOOL_FULL: Final = "the spool was full"
DAMAGED: Final = "damaged in the spool"

_SWEEP_S = 0.5  # Journals are cleared in one commit per sensor and interval.
_GAP_NUMBERS = 64  # Refused numbers to collect before the journal is written.


class DiskSpool(Spool):
    """Measurements in journals up to max_bytes, also in memory up to ring_bytes; any thread calls on_note."""

    def __init__(self, folder: Path, ring_bytes: int, max_bytes: int | None, *, on_note: Callable[[str], None]) -> None:
        super().__init__(ring_bytes)
        self._folder, self._on_note = folder, on_note
        self._limit_bytes = None if max_bytes is None else checks.integer("spool_bytes", max_bytes, 1)
        self._writing = threading.RLock()  # Acquired before `turn`, and never while `turn` is held.
        self._journals: dict[int, Journal] = {}  # Journals for measurements of this process, by session.
        self._found: list[Journal] = []
        self._open_gaps: dict[tuple[str, int], SequenceGap] = {}  # Gaps not yet written to the journal.
        self._discards: dict[tuple[str, int], tuple[Journal, int]] = {}
        self._failing = ""
        self._sweep_now, self._stopping = threading.Event(), threading.Event()
        self._sweeper = threading.Thread(target=self._sweep, name="spool", daemon=True)

    @property
    def is_durable(self) -> bool:
        """True if measurements outlive this process."""
        return True

    def open(self) -> None:
        """Open the journals that earlier nodes have left, oldest first."""
        try:
            make_folder(self._folder, parents=True)
            with tempfile.TemporaryFile(dir=self._folder):  # root may write regardless of the mode.
                pass
        except OSError as error:
            raise NetworkError(f"{self._folder}: {error.strerror}; choose a writable spool folder (spool)") from error
        for path in sorted(self._folder.glob(f"*{SUFFIX}")):
            try:
                journal = Journal.open(path)
                try:
                    self._report_losses(journal)
                    self._take_up(journal)
                except BaseException:
                    journal.close()
                    raise
            except JournalInUseError:
                continue  # Another sensor node's, or being sealed.
            except DataError as error:
                self._on_note(f"measurements in {path.name} are not sent: {error}")
        self._sweeper.start()

    def _report_losses(self, journal: Journal) -> None:
        """Report the losses of a damaged log; the central node receives them as gaps, too."""
        n_lost = sum(gap.n_missing for gap in journal.gaps if gap.reason == LOST)
        if n_lost:
            self._on_note(f"the log of {journal.path.name} was damaged; up to {n_lost} stored measurements are lost")
        if journal.damage:
            self._on_note(f"the log of {journal.path.name} was damaged; also lost: {journal.damage}")

    def _take_up(self, journal: Journal) -> None:
        runs: dict[tuple[str, int], OutgoingSession] = {}
        found = [(key.sequence, key.sequence, "", key.sensor, key.session_id) for key in journal.index()]
        found += [(gap.first, gap.last, gap.reason, gap.sensor, gap.session_id) for gap in journal.gaps]
        for first, last, reason, name, session_id in sorted(found):
            if last > MAX_SEQUENCE:
                raise DataError(
                    f"sequence number {last} is above {MAX_SEQUENCE}; recover it with 'ertis import journals "
                    f"{journal.path}'"
                )
            run = runs.setdefault((name, session_id), OutgoingSession(journal.sensors[name], session_id, journal))
            if reason:
                run.add_gap(first, last, reason)
            elif run.following is None or first >= run.following:
                run.add_measurement(first, run.sensor.n_bytes, entry=None)
        if not runs:
            journal.remove()
            return
        with self.turn:
            if runs.keys() & self.runs.keys():
                raise DataError(f"{journal.path} has sessions that another journal has, too; move it elsewhere")
            self.runs.update(runs)
            for run in runs.values():
                self.counts.setdefault(run.sensor.name, SensorCounts())
                for _ in filter(lambda item: not item.reason, run.items):
                    self._count_kept(run, run.sensor.n_bytes)
        self._found.append(journal)

    def append(self, entries: Sequence[JournalEntry]) -> list[JournalEntry]:
        """Store measurements durably, and return the stored ones; the others become gaps."""
        kept: list[JournalEntry] = []
        with self._writing:
            with self.turn:
                self.check(entries)
                free_bytes = self._free_bytes()
            taken: list[JournalEntry] = []
            refused: list[JournalEntry] = []
            for entry in entries:
                free_bytes -= entry.measurement.data.nbytes
                (taken if free_bytes >= 0 else refused).append(entry)
            for session_id, group in groupby(sorted(taken, key=_session_id), _session_id):
                fitting = list(group)
                try:
                    journal = self._journal(session_id, {entry.measurement.stamp.sensor for entry in fitting})
                    journal.append(fitting)
                except DataError as error:
                    self._report_failure(str(error))
                    refused += fitting
                else:
                    self._failing = ""
                    kept += fitting
                    self._add(journal, fitting)
            for entry in refused:
                self._refuse(entry)
        return kept

    def _free_bytes(self) -> float:
        if self._limit_bytes is None:
            return float("inf")
        return self._limit_bytes - sum(counts.unacked_bytes for counts in self.counts.values())

    def _journal(self, session_id: int, sensors: Iterable[str]) -> Journal:
        """Return the journal of a session with these sensors, created if it does not exist."""
        if session_id not in self._journals:
            with self.turn:
                found = next(
                    (run.journal for run in self.runs.values() if run.session_id == session_id and run.journal), None
                )
            self._journals[session_id] = found or self._make_journal(session_id)
        journal = self._journals[session_id]
        for name in sensors:
            if name not in journal.sensors:
                sensor = self._known(name)
                journal.add_sensor(
                    name,
                    sensor.settings,
                    firmware=sensor.firmware,
                    translation_m=sensor.translation_m,
                    rotation_xyzw=sensor.rotation_xyzw,
                )
        return journal

    def _make_journal(self, session_id: int) -> Journal:
        name = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{session_id:016x}.h5"
        return Journal.create(self._folder / f"{name}{SUFFIX}", target=name, source="spool of a sensor node")

    def _add(self, journal: Journal, entries: Iterable[JournalEntry]) -> None:
        """Add stored measurements to the items to send."""
        for entry in entries:
            stamp, n_bytes = entry.measurement.stamp, entry.measurement.data.nbytes
            self._report_gap((stamp.sensor, stamp.session_id))
            with self.turn:
                run = self._run(stamp.sensor, stamp.session_id)
                run.journal = journal
                if self._held_bytes + n_bytes <= self._max_bytes:
                    self._keep(run, entry)
                else:
                    run.add_measurement(stamp.sequence, n_bytes, entry=None)
                    self._count_kept(run, n_bytes)

    def _refuse(self, entry: JournalEntry) -> None:
        """Replace a measurement without room by a gap."""
        stamp = entry.measurement.stamp
        key = stamp.sensor, stamp.session_id
        gap = self._open_gaps.get(key)
        if gap is not None and gap.last + 1 != stamp.sequence:
            self._report_gap(key)
            gap = None
        first = stamp.sequence if gap is None else gap.first
        self._open_gaps[key] = SequenceGap(stamp.sensor, first, stamp.sequence, SPOOL_FULL, stamp.session_id)
        with self.turn:
            self.counts[stamp.sensor].refused += 1
            self._run(*key).add_gap(stamp.sequence, stamp.sequence, SPOOL_FULL)
        if stamp.sequence - first >= _GAP_NUMBERS:
            self._report_gap(key)

    def _report_gap(self, key: tuple[str, int]) -> None:
        """Store a gap durably; if the disk is too full even for that, it stays in memory."""
        gap = self._open_gaps.get(key)
        if gap is None:
            return
        with suppress(DataError):
            self._journal(gap.session_id, [gap.sensor]).note_gaps([gap])
            del self._open_gaps[key]

    def note_gap(self, gap: SequenceGap) -> None:
        """Register missing numbers of a sensor with their reason, durably if the disk allows."""
        with self._writing:
            super().note_gap(gap)
            try:
                journal = self._journal(gap.session_id, [gap.sensor])
                journal.note_gaps([gap])
            except DataError as error:
                self._report_failure(str(error))
            else:
                with self.turn:
                    self._run(gap.sensor, gap.session_id).journal = journal

    def entry(self, item: UnackedItem, run: OutgoingSession) -> JournalEntry | None:
        """Return the measurement of an item, read if it is not in memory; None if it is a gap."""
        entry = item.entry
        if entry is not None or item.reason or run.journal is None:
            return entry
        try:
            return run.journal.entry(run.journal.find(run.sensor.name, run.session_id, item.first))
        except DamagedError as error:
            self._on_note(str(error))
            with self.turn:
                item.reason = DAMAGED
                counts = self.counts[run.sensor.name]
                counts.damaged += 1
                counts.unacked -= 1
                counts.unacked_bytes -= item.n_bytes
                item.n_bytes = 0
            return None

    def settle(
        self,
        run: OutgoingSession,
        done: Iterable[UnackedItem],
        status: Literal["stored", "accepted"],
        dropped: Sequence[tuple[int, str]] = (),
    ) -> None:
        """Release and count acknowledged items; the journal is cleared later."""
        with self.turn:
            super().settle(run, done, status, dropped)
            if run.journal is not None:
                self._discards[run.key] = run.journal, run.acked_through
                self._sweep_now.set()

    def _sweep(self) -> None:
        while not self._stopping.is_set():
            self._sweep_now.wait()
            self._stopping.wait(_SWEEP_S)
            self._sweep_now.clear()
            self._clear()
        self._clear()

    def _clear(self) -> None:
        """Discard acknowledged items, and remove empty journals of earlier nodes."""
        with self.turn:
            discards, self._discards = self._discards, {}
        for (sensor, session_id), (journal, acked_through) in discards.items():
            try:
                journal.discard(sensor, session_id, acked_through)
            except DataError as error:
                self._report_failure(str(error))
                with self.turn:  # The next acknowledgement or the next start tries again.
                    self._discards.setdefault((sensor, session_id), (journal, acked_through))
        with self._writing:
            for key in list(self._open_gaps):
                self._report_gap(key)
            for journal in [journal for journal in self._found if journal not in self._journals.values()]:
                if self._is_empty(journal):
                    self._found.remove(journal)
                    self._end(journal)

    def _is_empty(self, journal: Journal) -> bool:
        with self.turn:
            return not len(journal) and not any(run.items for run in self.runs.values() if run.journal is journal)

    def _end(self, journal: Journal) -> None:
        """Remove a journal that is empty, or close it."""
        try:
            if self._is_empty(journal) and not journal.gaps:
                journal.remove()
                with self.turn:
                    for run in [run for run in self.runs.values() if run.journal is journal]:
                        del self.runs[run.key]
        except DataError as error:
            self._report_failure(str(error))
        journal.close()

    def _report_failure(self, text: str) -> None:
        """Report a full or failing disk, once until it works again."""
        if not self._failing:
            self._on_note(text)
        self._failing = text

    def close(self) -> None:
        """Close the journals; the next start sends their measurements."""
        if self._stopping.is_set():
            return
        self._stopping.set()
        self._sweep_now.set()
        if self._sweeper.ident is not None:
            self._sweeper.join()
        with self._writing:
            for journal in self._all():
                self._end(journal)

    def _all(self) -> Iterator[Journal]:
        yield from dict.fromkeys([*self._found, *self._journals.values()])


def _session_id(entry: JournalEntry) -> int:
    return entry.measurement.stamp.session_id
