"""Insertion and deletion of sensors, measurements and gaps of an open journal."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import _free_space
from ertis_numba.journal._contents import ReadableJournal
from ertis_numba.journal._database import LOG_BYTES, Database
from ertis_numba.journal._entries import JournalEntry, JournalSensor, require_same_settings
from ertis_numba.journal._files import disk_errors
from ertis_numba.journal._poses import JournalPose
from ertis_numba.journal._tables import POSES, VERSION, create_poses_statement, insert_statement, row_crc32
from ertis_numba.journal._tally import Tally
from ertis_numba.settings import Settings

__all__ = ["WritableJournal"]

_INSERTION: Final = insert_statement("measurements")


class WritableJournal(ReadableJournal):
    """An open journal for changes."""

    def __init__(self, path: Path, database: Database) -> None:
        super().__init__(path, database)
        self._accepted: dict[str, Settings] = {}
        self.tally = Tally(path)

    def add_sensor(
        self,
        name: str,
        settings: Settings,
        *,
        firmware: str = "",
        translation_m: Sequence[float] | None = None,
        rotation_xyzw: Sequence[float] | None = None,
    ) -> None:
        """Register a sensor before its first measurement; the air may differ, and layout files are stored."""
        made = JournalSensor.from_settings(
            name, settings, firmware=firmware, translation_m=translation_m, rotation_xyzw=rotation_xyzw
        )
        with self._lock:
            if name in self._sensors:
                raise ArgumentError(f"sensor {name!r} is in {self.path} already; use a different name for each sensor")
            with self._database.transaction():
                self._insert("sensors", made.row())
            self._register(len(self._ids) + len(self._unusable) + 1, made)

    def append(self, entries: Sequence[JournalEntry]) -> None:
        """Store measurements of any sensors durably, all or none, with numbers that rise within a session.

        ``crc32`` is filled in if it is None. Raises DiskFullError if the disk is nearly full and nothing was written,
        so that a later call may succeed; DataError if the disk fails (earlier measurements are safe); or
        JournalInUseError if another process removed or replaced the journal.
        """
        with self._lock:
            last = dict(self._last)
            rows = [self._row(entry, last) for entry in entries]
            sizes_bytes = [row[-1].nbytes for row in rows]
            seals_bytes = self._recording_bytes(sum(sizes_bytes), len(rows))
            _free_space.require_free_space(self.path, self.target, sizes_bytes=sizes_bytes, seals_bytes=seals_bytes)
            self._database.require_file()
            if sum(sizes_bytes) > LOG_BYTES:
                with suppress(DataError):
                    self._database.use_rollback_journal()
            with self._database.transaction():
                for row in rows:
                    self._database.execute(_INSERTION, row)
            self._last = last
            self._n_entries += len(rows)
            self._held_bytes += sum(sizes_bytes)
            first: dict[tuple[str, int], int] = {}
            for stamp in (entry.measurement.stamp for entry in entries):
                first.setdefault((stamp.sensor, stamp.session_id), stamp.sequence)
            for run, number in first.items():
                self.tally.record(*run, number, last[run])

    def _row(self, entry: JournalEntry, last: dict[tuple[str, int], int]) -> tuple[Any, ...]:
        """Return the row of a measurement, whose number must be above the one in ``last``."""
        stamp, settings = entry.measurement.stamp, entry.measurement.settings
        sensor = self._sensor(stamp.sensor)
        if settings is not self._accepted.get(sensor.name):
            require_same_settings(sensor, settings)
            self._accepted[sensor.name] = settings
        row = sensor.entry_row(entry, self._ids[sensor.name])
        key = (sensor.name, stamp.session_id)
        if stamp.sequence <= last.get(key, -1):
            raise ArgumentError(
                f"measurement {stamp.sequence} of sensor {sensor.name} follows {last[key]}; pass increasing numbers, "
                "or another session_id"
            )
        last[key] = stamp.sequence
        return row

    def note_gap(self, sensor: str, first: int, last: int, reason: str, *, session_id: int) -> None:
        """Store durably why numbers ``first`` to ``last`` included are missing, in a line of at most 64 bytes."""
        self.note_gaps([SequenceGap(sensor, first, last, reason, session_id)])

    def note_gaps(self, gaps: Sequence[SequenceGap]) -> None:
        """Store gaps durably, all or none."""
        with self._lock:
            rows = [
                (self._ids[self._sensor(gap.sensor).name], gap.session_id, gap.first, gap.last, gap.reason)
                for gap in gaps
            ]
            with self._database.transaction():
                for row in rows:
                    self._insert("gaps", row)
            for gap in gaps:
                self.tally.record(gap.sensor, gap.session_id, gap.first, gap.last)

    def append_poses(self, poses: Sequence[JournalPose]) -> None:
        """Store poses of platforms durably, all or none; errors are those of `append`."""
        with self._lock:
            sizes_bytes = [sum(pose.n_bytes for pose in poses)]
            seals_bytes = self._recording_bytes(adds_poses=True)
            _free_space.require_free_space(self.path, self.target, sizes_bytes=sizes_bytes, seals_bytes=seals_bytes)
            self._database.require_file()
            with self._database.transaction():
                self._database.execute(create_poses_statement())
                for pose in poses:
                    self._insert(POSES, pose.row())
            self._has_poses = True

    def discard(self, sensor: str, session_id: int, up_to: int) -> int:
        """Delete measurements up to a number that another node has stored, and gaps; durably. Return their number."""
        # Row numbers then have holes, so that readers count rows. A gap that extends beyond `up_to` is kept unchanged.
        known = self._sensor(sensor)
        which = self._ids[known.name], session_id, up_to
        with self._lock:
            # Deleted measurements need not be erased. Some builds of SQLite overwrite them, as slowly as they store.
            self._database.execute("PRAGMA secure_delete = OFF")
            self._database.require_file()
            with disk_errors(self.tally.path):
                self.tally.discard(sensor, session_id, up_to)
            with self._database.transaction():
                if self._database.execute("PRAGMA user_version") != [(VERSION,)]:
                    self._database.execute(f"PRAGMA user_version = {VERSION}")
                ((n_deleted,),) = self._database.execute(
                    "SELECT count(*) FROM measurements INDEXED BY key WHERE sensor = ? AND epoch = ? AND sequence <= ?",
                    which,
                )
                self._database.execute(
                    "DELETE FROM measurements WHERE sensor = ? AND epoch = ? AND sequence <= ?", which
                )
                self._database.execute("DELETE FROM gaps WHERE sensor = ? AND epoch = ? AND last <= ?", which)
            self._n_entries -= n_deleted
            self._held_bytes -= n_deleted * known.n_bytes
        return int(n_deleted)

    def _insert(self, table: str, values: tuple[Any, ...]) -> None:
        self._database.execute(insert_statement(table), (*values, row_crc32(values)))

    def appendable_bytes(self) -> int:
        """Return the approximate number of bytes of samples that can be appended while sealing stays possible."""
        with self._lock:
            return _free_space.appendable_bytes(self.path, self.target, seals_bytes=self._recording_bytes())

    def _recording_bytes(self, more_bytes: int = 0, n_more: int = 0, *, adds_poses: bool = False) -> int:
        """Return the approximate size of the recording with additional measurements or poses."""
        return _free_space.recording_bytes(
            self._held_bytes + more_bytes,
            n_rows=len(self) + n_more,
            n_sensors=len(self._sensors),
            has_poses=adds_poses or self._has_poses,
        )
