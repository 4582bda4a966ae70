"""Verification of recordings and journals: missing and damaged measurements."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import h5py

from ertis_numba.analysis.sample_faults import are_copies
from ertis_numba.base.errors import ArgumentError, DamagedError, DataError, ForeignDataError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import Journal
from ertis_numba.storage._journal_rows import DamagedMeasurement, JournalRows, damaged_poses
from ertis_numba.storage._reader import sensor_names
from ertis_numba.storage.recording import JOURNAL_DAMAGE, RecordingReader, open_recording
from ertis_numba.storage.schema import POSES, RECORDING, RECORDING_OF_PCM
from ertis_numba.storage.structure import require_attributes, stored_bytes

__all__ = ["DamagedMeasurement", "SensorReport", "find_damage", "verify"]

_MAX_BYTES: Final = 16 * 2**20  # Limit for a dataset that no table names.
_DIMS: Final = {variable.name: variable.dims for variable in (*RECORDING, *RECORDING_OF_PCM, *POSES)}
# Errors of h5py for damaged files.
_UNREADABLE: Final = (OSError, RuntimeError, LookupError, AttributeError, TypeError, ValueError)


def find_damage(path: Path) -> str:
    """Return the first damaged object of a file and its damage, as one line; empty if there is none."""
    # HDF5 has no checksums of references from variables to their axes, which are compared with the expected names.
    place = "/"
    try:
        with h5py.File(path, "r") as file:
            names: list[str] = []
            file.visit(names.append)
            for place in ("/", *names):
                if wrong := _damage_of(file, file[place]):
                    return f"{place}: {wrong}"
    except ForeignDataError:
        raise
    except DamagedError as error:
        return str(error)
    except _UNREADABLE as error:
        reason = str(error.args[0]).partition("\n")[0] if error.args else type(error).__name__
        return f"{place} cannot be read ({reason})"
    return ""


def _damage_of(file: h5py.File, item: h5py.Group | h5py.Dataset) -> str:
    require_attributes(item)
    for name in item.attrs:
        with suppress(TypeError):  # Other programs add types without an equivalent in NumPy.
            item.attrs[name]
    for reference, axis in item.attrs.get("REFERENCE_LIST", ()):
        if item not in list(file[reference].dims[int(axis)].values()):
            return f"is not an axis of {file[reference].name}"
    if not isinstance(item, h5py.Dataset):
        return ""
    name = item.name.rpartition("/")[2]
    if name not in _DIMS and item.shape is not None and not _is_empty_scale(item):
        stored_bytes(item, may_be_filtered=True)
        if item.nbytes <= _MAX_BYTES:
            item[()]
    if "/truth/" in item.name or item.is_scale:
        return ""
    return _axes_mismatch(item, _DIMS.get(name, ()))


def _is_empty_scale(item: h5py.Dataset) -> bool:
    """Return True if a dataset is an axis without values, which stores nothing."""
    is_here = not (item.is_virtual or item.external)
    return bool(item.is_scale and is_here and not item.id.get_storage_size())


def _axes_mismatch(item: h5py.Dataset, wanted: tuple[str, ...]) -> str:
    found: list[Any] = [scale.name.rpartition("/")[2] for axis in item.dims for scale in axis.values()]
    dims = [dim for dim in wanted if dim in item.parent][: item.ndim]
    return "" if found == dims or not found or not dims else f"has axes {', '.join(found)}, wanted {', '.join(dims)}"


_SQLITE = b"SQLite format 3\0"


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorReport:
    """Result for one sensor; ``fault`` is the reason why nothing of it can be read."""

    # `out_of_order` numbers are not above the previous one, and `copies` equal the measurement before. `remark`
    # describes damage to the file or to poses, and losses from its journal that no gap covers.

    sensor: str
    measurements: int = 0
    gaps: tuple[SequenceGap, ...] = ()
    damaged: tuple[DamagedMeasurement, ...] = ()
    out_of_order: tuple[int, ...] = ()
    fault: str = ""
    remark: str = ""
    copies: tuple[int, ...] = ()

    @property
    def missing(self) -> int:
        """Number of missing sequence numbers."""
        return sum(gap.n_missing for gap in self.gaps)

    @property
    def is_intact(self) -> bool:
        """True if all measurements are present and intact."""
        return not (self.gaps or self.damaged or self.out_of_order or self.fault or self.remark)


def verify(path: str | Path) -> list[SensorReport]:
    """Read a whole recording or journal, and return missing and damaged measurements for each sensor."""
    # This checks the hash of each sensor, the CRC-32 of each measurement, and the order of the sequence numbers.
    path = Path(path)
    if _is_journal(path):
        with Journal.open(path) as journal:
            if journal.damage and not journal.sensors:
                raise DataError(
                    f"{path} has lost measurements, because its log was damaged ({journal.damage}); copy journal and "
                    "log again"
                )
            remark = "; ".join(filter(None, (_lost(journal), _pose_damage(journal))))
            reports = [_of_journal(journal, name, remark) for name in journal.sensors]
            reports += [
                SensorReport(sensor=name, measurements=count, fault=reason)
                for name, (reason, count) in journal.unusable.items()
            ]
        if reports and all(report.fault for report in reports):
            raise DataError(reports[0].fault)
        return reports
    names = sensor_names(path)
    structure = find_damage(path)
    reports = [_of_recording(path, name, structure) for name in names]
    if all(report.fault for report in reports):
        raise DataError(reports[0].fault if reports else f"{path} contains no sensor; copy it again")
    return reports


def _is_journal(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; choose a recording or a journal") from error


def _of_recording(path: Path, sensor: str, structure: str) -> SensorReport:
    try:
        recording = open_recording(path, sensor=sensor)
    except ForeignDataError:  # This package did not write the file, so no part of it is examined.
        raise
    except (ArgumentError, DataError) as error:
        return SensorReport(sensor=sensor, fault=str(error))
    damaged: list[DamagedMeasurement] = []
    copies, last = [], None
    with recording:
        stamps = recording.stamps()
        for index, stamp in enumerate(stamps):
            try:
                data = recording[index].data
            except DamagedError as error:
                damaged.append(DamagedMeasurement(index, stamp.sequence, str(error)))
                continue
            # Simulated measurements without noise are alike.
            if recording.truth is None and last is not None and are_copies(last, data):
                copies.append(index)
            last = data
        return SensorReport(
            sensor=sensor,
            measurements=len(recording),
            gaps=recording.gaps,
            damaged=tuple(damaged),
            out_of_order=_out_of_order((stamp.session_id, stamp.sequence) for stamp in stamps),
            remark="; ".join(filter(None, (_journal_damage(recording), structure))),
            copies=tuple(copies),
        )


def _journal_damage(recording: RecordingReader) -> str:
    damage = recording.attributes.get(JOURNAL_DAMAGE, "")
    return f"lost in a damaged journal: {damage}" if damage else ""


def _out_of_order(numbers: Iterable[tuple[int, int]]) -> tuple[int, ...]:
    """Return the indices of numbers that are not above the previous one of the session."""
    last: dict[int, int] = {}
    found = []
    for index, (session_id, number) in enumerate(numbers):
        if number <= last.get(session_id, number - 1):
            found.append(index)
        last[session_id] = number
    return tuple(found)


def _lost(journal: Journal) -> str:
    return f"lost in a damaged journal: {journal.damage}" if journal.damage else ""


def _pose_damage(journal: Journal) -> str:
    """Return a message about damaged poses of any sensor; empty if there are none."""
    n_damaged = 0
    try:
        for _, n_more in journal.pose_blocks():
            n_damaged += n_more
    except DamagedError as error:
        return f"poses cannot be read: {error}"
    return damaged_poses(n_damaged)


def _of_journal(journal: Journal, sensor: str, remark: str) -> SensorReport:
    rows = JournalRows(journal, sensor)
    for _ in rows:
        pass
    return SensorReport(
        sensor=sensor,
        measurements=len(rows),
        gaps=tuple(rows.missing),
        damaged=tuple(rows.damaged),
        out_of_order=_out_of_order((key.session_id, key.sequence) for key in rows.keys),
        remark=remark,
    )
