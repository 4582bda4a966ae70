"""Sealing: a journal becomes a recording and is removed.

Run it as a separate process::

    python -m ertis_numba.storage.sealing_process REC.h5.journal

HDF5 can crash its process when a disk fails (h5py issue 914); a separate process confines this. It may be killed and
run again at any time: the recording is the same.
"""

from collections.abc import Callable, Container, Iterable, Iterator
from itertools import zip_longest
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np

from ertis_numba.base.atomic_files import fsync, temporary_path
from ertis_numba.base.errors import DamagedError, DataError
from ertis_numba.frames import Measurement, Trajectory
from ertis_numba.geometry import mounting as mounted, storable
from ertis_numba.journal import (
    LOST,
    SUFFIX,
    Journal,
    JournalSensor,
    PosesAround,
    SealingResult,
)
from ertis_numba.storage._journal_rows import JournalRows, damaged_poses
from ertis_numba.storage._poses import MAX_GAP_S
from ertis_numba.storage._reader import sensor_names
from ertis_numba.storage.recording import JOURNAL_DAMAGE, RecordingReader, RecordingWriter, open_recording
from ertis_numba.storage.recording_variables import create_sensor_variables
from ertis_numba.storage.schema import sensor_path

__all__ = ["PART_TOKEN", "REFUSED_SUFFIX", "seal"]

REFUSED_SUFFIX = "refused"
"""Suffix of a journal that is kept because a recording cannot contain one of its sensors."""

MAX_HISTORY = 16_000  # Characters; an attribute of HDF5 is limited to 65,536 bytes.

PART_TOKEN = "sealing"  # noqa: S105
"""Token in the name of the temporary file. It is fixed, because only the process with the journal writes the file."""

Progress = Callable[[int, int], None]


def seal(path: str | Path, *, overwrite: bool = False, progress: Progress = lambda _done, _of: None) -> SealingResult:
    """Make the recording of a journal, verify and sync it, and then remove the journal."""
    # Damaged or refused measurements become gaps, and their journal is kept under another name. Without `overwrite`, an
    # existing file with other content raises DataError.
    path = Path(path)
    before = path.with_name(path.name.removesuffix(SUFFIX))
    # An earlier process may have been killed just after it had removed the journal.
    if not path.exists() and before != path and _is_sealed_from(path, before):
        return _summary(path, before)
    with Journal.open(path) as journal:
        target = journal.target
        temporary_path(target, PART_TOKEN).unlink(missing_ok=True)
        rows = {name: JournalRows(journal, name) for name in journal.sensors}
        refused = _remove_refused(journal, rows)
        if refused and not any(map(len, rows.values())):
            damage = _damage(journal, rows)  # The damage is recorded in the tally, which is removed with the journal.
            return SealingResult(
                path, None, set_aside=journal.set_aside(REFUSED_SUFFIX), damage=damage, refused=refused
            )
        if not len(journal):
            _require_nothing_lost(journal)
            journal.remove()
            return SealingResult(path, None)
        poses, pose_damage = _poses(journal)
        if target.is_file() and _is_complete_recording(target, journal, rows, poses):
            for place in (target, target.parent):  # The writer may have been killed before it did this.
                fsync(place)
        elif target.is_file() and not overwrite:
            raise DataError(f"{target} exists with other content than {path}; move it, or replace it (overwrite=True)")
        else:
            history = [f"sensor {name} was set aside: {reason}" for name, reason in refused.items()]
            history += [pose_damage] if pose_damage else []
            _write(journal, rows, poses, history, overwrite=overwrite, progress=progress)
        n_damaged = sum(len(held.damaged) for held in rows.values())
        if n_damaged or pose_damage or refused:
            aside = journal.set_aside("damaged" if n_damaged or pose_damage else REFUSED_SUFFIX)
            return _summary(
                path, target, poses, damaged=n_damaged, set_aside=aside, refused=refused, pose_damage=pose_damage
            )
        journal.remove()
    return _summary(path, target, poses)


def _require_nothing_lost(journal: Journal) -> None:
    """Refuse to remove an empty journal that contained measurements before its log was damaged."""
    lost = [journal.damage] if journal.damage else []
    lost += [f"{gap.first} to {gap.last} of sensor {gap.sensor}" for gap in journal.gaps if gap.reason == LOST]
    if lost:
        raise DataError(
            f"{journal.path} has lost all its measurements, because its log was damaged ({'; '.join(lost)}); copy "
            "journal and log again if you can, or remove the journal"
        )


def _damage(journal: Journal, rows: dict[str, JournalRows]) -> str:
    """Return the losses of a damaged log that no gap of the recording covers."""
    absent = (
        f"{missing.first} to {missing.last} of sensor {name}"
        for name, held in rows.items()
        if len(held) == len(held.damaged)
        for missing in held.missing
        if missing.reason == LOST
    )
    return "; ".join([*([journal.damage] if journal.damage else []), *absent])


def _remove_refused(journal: Journal, rows: dict[str, JournalRows]) -> dict[str, str]:
    """Return the reasons why a recording cannot contain some sensors, and remove these sensors from the rows."""
    refused = {name: reason for name, (reason, count) in journal.unusable.items() if count}
    for name, held in list(rows.items()):
        first = next(iter(held), None)
        reason = "" if first is None else _refusal_reason(journal.sensors[name], first.measurement)
        if reason:
            refused[name] = reason
            del rows[name]
    return refused


def _refusal_reason(sensor: JournalSensor, first: Measurement) -> str:
    """Return the reason why a recording cannot contain a sensor, from a trial in memory; empty if it can."""
    try:
        with h5py.File("trial", "w", driver="core", backing_store=False, libver=("v110", "v110")) as trial:
            create_sensor_variables(
                trial.create_group(sensor_path(sensor.name), track_order=True),
                storable(first.settings),
                firmware=sensor.firmware,
                mounting=mounted(sensor.name, sensor.translation_m, sensor.rotation_xyzw),
            )
    except MemoryError:  # The lack of memory may be temporary.
        raise
    except Exception as error:  # noqa: BLE001  no error may prevent sealing of other sensors
        return " ".join(str(error).split()) or type(error).__name__
    return ""


def _history_of(path: Path) -> str:
    """Return the first part of a recording's history, which names its journal."""
    return f"sealed from {path.name.encode(errors='backslashreplace').decode()}"  # The name may not be valid text.


def _is_sealed_from(path: Path, recording: Path) -> bool:
    """Return True if a file is the recording of a removed journal with this name."""
    try:
        with open_recording(recording, sensor=sensor_names(recording)[0]) as reader:
            history = str(reader.attributes.get("history", ""))
    except (DataError, IndexError):
        return False
    return f"{history}; ".startswith(f"{_history_of(path)}; ")


class _SealingWriter(RecordingWriter):
    _part_token: ClassVar[str | None] = PART_TOKEN
    # The journal's index keeps numbers unique, and damage must not prevent sealing the rest.
    _numbered: ClassVar[bool] = False

    def set_history(self, history: str) -> None:
        """Set the history of the recording."""
        self._attributes["history"] = history

    def report_damage(self, damage: str) -> None:
        """Store a description of losses that no gap covers."""
        self._attributes[JOURNAL_DAMAGE] = damage

    def _require_samples(self, item: Measurement) -> None:
        """Accept all samples: the journal has checked their type; non-finite numbers must not prevent sealing."""

    def _warn_of_poses(self) -> None:
        """Leave warnings to the programs that send poses."""

    def _require_sensors(self, name: str, given: Iterable[str]) -> None:
        """Accept data of sensors without measurements: the history mentions them."""


def _write(
    journal: Journal,
    rows: dict[str, JournalRows],
    poses: dict[str, Trajectory],
    history: list[str],
    *,
    overwrite: bool,
    progress: Progress,
) -> None:
    sensors = [journal.sensors[name] for name in rows]
    with _SealingWriter(
        journal.target,
        overwrite=overwrite,
        source=journal.source,
        mounting={
            sensor.name: (sensor.translation_m, sensor.rotation_xyzw)
            for sensor in sensors
            if sensor.translation_m is not None and sensor.rotation_xyzw is not None
        },
        firmware={sensor.name: sensor.firmware for sensor in sensors},
        poses={name: trajectory for name, trajectory in poses.items() if name in rows},
    ) as writer:
        n_written = 0
        for name, held in rows.items():
            for entry in held:
                writer.write(entry.measurement)
                n_written += 1
                progress(n_written, len(journal))
            for gap in held.missing:
                writer.note_gap(name, gap.first, gap.last, gap.reason, gap.session_id)
        if not n_written:
            raise DataError(f"{journal.path}: all {len(journal)} measurements are damaged; copy it again if you can")
        if damage := _damage(journal, rows):
            writer.report_damage(damage)
        history = [_history_of(journal.path), *_history_of_lost_sensors(rows), *history]
        writer.set_history("; ".join(history)[:MAX_HISTORY])


def _poses(journal: Journal) -> tuple[dict[str, Trajectory], str]:
    """Return the trajectory of the platform of each sensor that has one, and a line about damage to poses."""
    around: dict[str, PosesAround] = {}
    n_damaged = 0
    try:
        for poses, n_more in journal.pose_blocks():
            n_damaged += n_more
            for name in {name for pose in poses for name in pose.sensors}.intersection(journal.sensors):
                if name not in around:
                    around[name] = PosesAround(_times_ns(journal, name), max_gap_s=MAX_GAP_S)
                around[name].add([pose for pose in poses if name in pose.sensors])
        made = {name: each.trajectory() for name, each in around.items()}
        trajectories = {name: trajectory for name, trajectory in made.items() if trajectory is not None}
    except (DamagedError, ValueError) as error:  # Measurements are sealed without poses.
        return {}, f"poses were left out: {' '.join(str(error).split())}"
    return trajectories, damaged_poses(n_damaged)


def _times_ns(journal: Journal, sensor: str) -> list[int]:
    """Return the times of the measurements of a sensor."""
    try:
        return journal.times_ns(sensor)
    except DamagedError:  # Measurements outside the damaged part can still be read.
        return [entry.measurement.stamp.timestamp_ns for entry in JournalRows(journal, sensor)]


def _history_of_lost_sensors(rows: dict[str, JournalRows]) -> Iterator[str]:
    """Yield parts of the history on sensors without readable measurements, which a recording cannot contain."""
    for name, held in rows.items():
        if len(held) == len(held.damaged):
            yield f"sensor {name} has no measurement"
            yield from (f"{gap.first} to {gap.last}: {gap.reason}" for gap in held.missing)


def _is_complete_recording(
    target: Path, journal: Journal, rows: dict[str, JournalRows], poses: dict[str, Trajectory]
) -> bool:
    """Return True if a file is the complete, undamaged recording of a journal."""
    try:
        names = sensor_names(target)
        return set(names) <= set(rows) and all(
            _same(journal.sensors[name], held, open_recording(target, sensor=name), poses.get(name))
            if name in names
            else not any(True for _ in held)
            for name, held in rows.items()
        )
    except DataError:
        return False


def _same(sensor: JournalSensor, rows: JournalRows, recording: RecordingReader, trajectory: Trajectory | None) -> bool:
    with recording:
        place = (recording.translation_m, recording.rotation_xyzw)
        known = (*(None if part is None else tuple(part.tolist()) for part in place), recording.firmware)
        if known != (sensor.translation_m, sensor.rotation_xyzw, sensor.firmware) or recording.truth is not None:
            return False
        for entry, back in zip_longest(rows, recording):
            if entry is None or back is None or not _equal(entry.measurement, back):
                return False
        return list(recording.gaps) == rows.missing and _has_poses(recording, trajectory)


def _has_poses(recording: RecordingReader, trajectory: Trajectory | None) -> bool:
    """Return True if a recording has the poses of a trajectory at its measurements, and no others."""
    time_ns = np.unique([stamp.timestamp_ns for stamp in recording.stamps()])
    if trajectory is None or not trajectory.covers(time_ns).any():
        return recording.trajectory is None
    covered = time_ns[trajectory.covers(time_ns)]
    wanted, got = trajectory.at(covered), recording.trajectory
    return got is not None and all(
        np.array_equal(getattr(wanted, name), getattr(got, name))
        for name in ("time_ns", "position_m", "rotation_xyzw", "covariance")
    )


def _equal(one: Measurement, other: Measurement) -> bool:
    return (one.stamp, one.settings) == (other.stamp, other.settings) and np.array_equal(one.data, other.data)


def _summary(
    path: Path,
    recording: Path,
    poses: Container[str] = (),
    *,
    damaged: int = 0,
    set_aside: Path | None = None,
    refused: dict[str, str] | None = None,
    pose_damage: str = "",
) -> SealingResult:
    """Return the result of sealing; ``poses`` are the sensors for which the journal has poses."""
    n_measurements = n_missing = n_lost = n_without_pose = 0
    damage = ""
    for name in sensor_names(recording):
        with open_recording(recording, sensor=name) as reader:
            n_measurements += len(reader)
            if reader.trajectory is not None:
                covered = reader.trajectory.covers([stamp.timestamp_ns for stamp in reader.stamps()])
                n_without_pose += int(np.count_nonzero(~covered))
            elif name in poses:  # None of them is near a measurement.
                n_without_pose += len(reader)
            n_missing += sum(gap.n_missing for gap in reader.gaps)
            n_lost += sum(gap.n_missing for gap in reader.gaps if gap.reason == LOST)
            damage = str(reader.attributes.get(JOURNAL_DAMAGE, ""))
    return SealingResult(
        path,
        recording,
        n_measurements,
        n_missing,
        damaged,
        set_aside,
        n_lost,
        damage,
        refused or {},
        n_without_pose,
        pose_damage,
    )
