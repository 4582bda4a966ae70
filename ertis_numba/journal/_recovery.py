"""Recovery of a journal with a damaged log: a repaired copy gives later commits, and lost numbers become gaps."""

import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ertis_numba.base.errors import ArgumentError, DamagedError, DataError
from ertis_numba.base.units import counted
from ertis_numba.frames import SequenceGap
from ertis_numba.journal._database import Database
from ertis_numba.journal._entries import JournalEntry, JournalSensor, verified_values
from ertis_numba.journal._files import keep_damaged_log
from ertis_numba.journal._log import WriteAheadLog
from ertis_numba.journal._poses import JournalPose, read_poses
from ertis_numba.journal._tables import POSES, select_statement

if TYPE_CHECKING:
    from ertis_numba.journal._journal import Journal

__all__ = ["LOST", "recover_rows"]

LOST: Final = "lost in a damaged journal"
"""Reason of a gap for numbers that the journal had noted before its log was damaged.

The journal contained the last of these numbers. The others may belong to stored measurements or gaps, or may have been
skipped by the sensor.
"""


@dataclass(slots=True)
class _RecoveredRows:
    """Rows of a repaired copy that the journal lacks; ``is_complete`` if all rows have readable numbers without holes.

    ``lost`` measurements have an intact record and damaged samples; ``n_unreadable`` counts all others.
    """

    header: list[Any] = field(default_factory=list)
    sensors: list[JournalSensor] = field(default_factory=list)
    entries: list[JournalEntry] = field(default_factory=list)
    gaps: list[SequenceGap] = field(default_factory=list)
    poses: list[JournalPose] = field(default_factory=list)
    lost: list[SequenceGap] = field(default_factory=list)
    n_unreadable: int = 0
    pose_damage: str = ""
    is_complete: bool = False


def recover_rows(journal: "Journal", database: Database, log: WriteAheadLog | None) -> str:
    """Recover rows that SQLite does not read in the log from before opening; return losses that no gap covers."""
    n_commits = log.n_lost_commits if log is not None else 0
    try:
        missing = list(_missing(journal))
    except DamagedError:  # The record of a gap is damaged, which prevents sealing anyway.
        return ""
    if not n_commits and not missing:
        return ""
    found = kept = None
    if log is not None:
        with suppress(OSError):
            kept = keep_damaged_log(journal.path, log.content)
        with suppress(DataError, OSError):
            found = _read_copy(journal, database, log)
    unrecorded = [] if found is None else _store_recovered(journal, found)
    if n_commits and found is None and not missing:
        unrecorded.append(f"{counted(n_commits, 'commit')} of unknown content")
    if found is not None:
        unrecorded += _record_lost(journal, found.lost)
    is_complete = found is not None and found.is_complete
    # If all rows were recovered, the numbers between them were skipped by the sensor and are not lost.
    unrecorded += _record_lost(journal, _missing(journal) if is_complete else missing)
    if kept and not (unrecorded or missing or found is None or found.entries or found.gaps or found.lost):
        kept.unlink(missing_ok=True)  # The log contains only rows that were deleted afterwards.
    return "; ".join(unrecorded)


def _record_lost(journal: "Journal", gaps: Iterable[SequenceGap]) -> list[str]:
    """Note lost numbers as gaps, and return the losses of sensors that the journal does not contain."""
    unrecorded = []
    for gap in list(gaps):
        if gap.sensor in journal.sensors:
            journal.note_gaps(list(_missing_parts(journal, gap)))
        else:
            unrecorded.append(f"up to {counted(gap.n_missing, 'number')} of sensor {gap.sensor}")
    return unrecorded


def _stored_ranges(journal: "Journal") -> Iterator[tuple[tuple[str, int], int, int]]:
    """Yield the numbers of measurements and gaps in a journal: session, first and last number."""
    for key in journal.index():
        yield (key.sensor, key.session_id), key.sequence, key.sequence
    for gap in journal.gaps:
        yield (gap.sensor, gap.session_id), gap.first, gap.last


def _missing(journal: "Journal") -> Iterator[SequenceGap]:
    """Yield the numbers that the tally lists and the journal lacks."""
    if not journal.tally.ranges:
        return
    highest: dict[tuple[str, int], int] = {}
    for run, _, last in _stored_ranges(journal):
        highest[run] = max(last, highest.get(run, -1))
    for run, mark in journal.tally.ranges.items():
        before = max(highest.get(run, -1), mark.first - 1, mark.discarded)
        if mark.last > before:
            yield SequenceGap(mark.sensor, before + 1, mark.last, LOST, mark.session_id)


def _missing_parts(journal: "Journal", gap: SequenceGap) -> Iterator[SequenceGap]:
    """Yield the parts of a gap without numbers that the journal contains."""
    begin = gap.first
    held = sorted((first, last) for run, first, last in _stored_ranges(journal) if run == (gap.sensor, gap.session_id))
    for first, last in [*held, (gap.last + 1, gap.last + 1)]:
        if begin < first <= gap.last + 1:
            yield SequenceGap(gap.sensor, begin, first - 1, gap.reason, gap.session_id)
        begin = max(begin, last + 1)


def _read_copy(journal: "Journal", database: Database, log: WriteAheadLog) -> _RecoveredRows:
    """Read lacking rows from a copy with the repaired log; by their checksums, a wrong repair gives no wrong row."""
    n_bytes = journal.path.stat().st_size + 2 * len(log.content)
    if shutil.disk_usage(journal.path.parent).free < 2 * n_bytes:
        raise DataError(f"{journal.path.parent} has no space for a copy of {journal.path.name}; free some space")
    with tempfile.TemporaryDirectory(prefix=f".{journal.path.name}.", dir=journal.path.parent) as folder:
        copy = Path(folder) / journal.path.name
        database.copy_to(copy)
        copy.with_name(f"{copy.name}-wal").write_bytes(log.repaired)
        repaired = Database(copy, empty=False)
        try:
            return _read(journal, database, repaired)
        finally:
            repaired.close()


def _read(journal: "Journal", database: Database, repaired: Database) -> _RecoveredRows:
    found = _RecoveredRows()
    with suppress(DamagedError, ValueError):
        (row,) = repaired.execute(select_statement("journal"))
        found.header = verified_values(journal.path, "the journal", row)
    sensors = {
        row[0]: JournalSensor.from_row(journal.path, row) for row in repaired.execute(select_statement("sensors"))
    }
    found.sensors = [sensors[number] for number in sorted(sensors) if sensors[number].name not in journal.sensors]
    ends = database.max_ids()
    rows = repaired.execute("SELECT id FROM measurements NOT INDEXED WHERE id > ? ORDER BY id", (ends["measurements"],))
    for (number,) in rows:
        record: list[int] = []
        try:
            (row,) = repaired.execute(select_statement("measurements", "WHERE id = ?"), (number,))
            record = verified_values(journal.path, "a measurement", row[:-1])
            found.entries.append(sensors[record[0]].entry(journal.path, row))
        except (DamagedError, KeyError, ValueError):
            if record and record[0] in sensors:
                found.lost.append(SequenceGap(sensors[record[0]].name, record[2], record[2], LOST, record[1]))
            else:
                found.n_unreadable += 1
    gaps = repaired.execute(select_statement("gaps", "WHERE id > ? ORDER BY id"), (ends["gaps"],))
    for row in gaps:
        with suppress(DamagedError, KeyError):
            number, session_id, first, last, reason = verified_values(journal.path, "a gap", row)
            found.gaps.append(SequenceGap(sensors[number].name, first, last, reason, session_id))
    try:
        found.poses, n_damaged = read_poses(repaired, journal.path, after=ends.get(POSES, 0))
        found.pose_damage = f"damaged poses: {n_damaged}" if n_damaged else ""
    except DamagedError:
        found.pose_damage = "poses that cannot be read"
    found.is_complete = (
        not found.n_unreadable
        and len(found.gaps) == len(gaps)
        and _is_unbroken(rows, ends["measurements"])
        and _is_unbroken(gaps, ends["gaps"])
    )
    return found


def _is_unbroken(rows: Sequence[tuple[Any, ...]], end: int) -> bool:
    """Return True if the ids of rows, their first column, continue after ``end`` without holes."""
    return [row[0] for row in rows] == list(range(end + 1, end + 1 + len(rows)))


def _store_recovered(journal: "Journal", found: _RecoveredRows) -> list[str]:
    """Store the recovered rows, and return the losses that no gap can cover."""
    if found.header:
        journal.restore_header(found.header)
    for sensor in found.sensors:
        with suppress(ArgumentError):
            journal.add_sensor(
                sensor.name,
                sensor.settings,
                firmware=sensor.firmware,
                translation_m=sensor.translation_m,
                rotation_xyzw=sensor.rotation_xyzw,
            )
    for entry in found.entries:
        with suppress(ArgumentError):  # A log left by an earlier crash may contain stored rows.
            journal.append([entry])
    journal.note_gaps([gap for gap in found.gaps if gap.sensor in journal.sensors])
    if found.poses:
        journal.append_poses(found.poses)
    unreadable = (
        [f"{counted(found.n_unreadable, 'measurement')} whose numbers cannot be read"] if found.n_unreadable else []
    )
    return [*unreadable, found.pose_damage] if found.pose_damage else unreadable
