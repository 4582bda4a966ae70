"""Rows along time: one array per measurement, and one number per measurement and column."""

import zlib
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.atomic_files import require_free_space
from ertis_numba.base.errors import ArgumentError, DamagedError
from ertis_numba.frames import BEHAVIOURS, Behaviour, Stamp
from ertis_numba.storage._gaps import SensorSequences
from ertis_numba.storage.schema import CHUNK_ROWS

__all__ = ["RowReader", "RowWriter"]

_STAMP_FIELDS = {
    "time": "timestamp_ns",
    "time_uncertainty": "timestamp_uncertainty_ns",
    "sequence": "sequence",
    "sync_count": "sync_count",
    "session_id": "session_id",
}
_BEHAVIOUR_CODES: Final[dict[Behaviour, int]] = {"active": 1, "passive": 0, "unknown": -1}
_BEHAVIOURS: Final = {code: behaviour for behaviour, code in _BEHAVIOUR_CODES.items()}
_COUNT = (0, 2**63 - 1)
_INT64 = (-(2**63), 2**63 - 1)
_LIMITS = {
    "timestamp_ns": _INT64,
    "timestamp_uncertainty_ns": (0, 2**32 - 1),
    "sequence": _COUNT,
    "sync_count": _INT64,
    "session_id": _COUNT,
}


class RowWriter:
    """Writer of measurements to the variables of a sensor; ``numbered`` requires unique numbers within a session."""

    def __init__(self, group: h5py.Group, data: str, *, numbered: bool) -> None:
        self._group = group
        self._data = group[data]
        self._numbered = numbered
        self._folder = Path(group.file.filename).parent
        self._columns: dict[str, list[float]] = {}
        self._n_stored = 0
        self._n_rows = 0
        self.runs = SensorSequences()
        self.check = 0
        """CRC-32 over all rows, for the comparison with the written file."""

    def append(self, row: NDArray[Any], stamp: Stamp, **columns: float) -> None:
        """Append one measurement: its array as one chunk, and its number in every column."""
        stored = np.ascontiguousarray(row, dtype=self._data.dtype)
        checks.shape(f"measurement {self._n_rows}", stored.shape, self._data.shape[1:])
        stamps = {
            name: checks.integer(field, getattr(stamp, field), *_LIMITS[field]) for name, field in _STAMP_FIELDS.items()
        }
        checks.choice("behaviour", stamp.behaviour, BEHAVIOURS)
        stamps["behaviour"] = _BEHAVIOUR_CODES[stamp.behaviour]
        self._require_new(stamps["sequence"], stamps["session_id"])
        require_free_space(self._folder, stored.nbytes)
        self._data.resize(self._n_rows + 1, axis=0)
        # Each row is one chunk without a filter, because filters cannot compress one-bit noise.
        self._data.id.write_direct_chunk((self._n_rows, *[0] * stored.ndim), stored)
        self._n_rows += 1
        self.runs.add(stamps["sequence"], stamps["session_id"])
        self.check = zlib.crc32(stored.data, self.check)
        for name, value in {**stamps, "crc32": zlib.crc32(stored.data), **columns}.items():
            self._columns.setdefault(name, []).append(value)
        if self._n_rows % CHUNK_ROWS == 0:
            self.flush()

    def _require_new(self, sequence: int, session_id: int) -> None:
        if self._numbered and self.runs.contains(sequence, session_id):
            raise ArgumentError(
                f"measurement {self._n_rows} has sequence {sequence} of session {session_id}, like an earlier "
                "one; number the measurements of a sensor without repetition (Stamp.sequence)"
            )

    def flush(self) -> None:
        """Write the columns gathered so far."""
        for name, values in self._columns.items():
            column = self._group[name]
            column.resize((self._n_rows,))
            column[self._n_stored :] = values
            column.flush()  # Its place in the file must not depend on when the last reference to it ends.
            values.clear()
        self._n_stored = self._n_rows

    def __len__(self) -> int:
        return self._n_rows


class RowReader:
    """Reader of measurements, which checks each against its CRC-32; ``name`` is that of a row in errors."""

    def __init__(self, group: h5py.Group, data: str, name: str = "measurement") -> None:
        self._name = name
        self._group = group
        self._data = group[data]
        self._columns: dict[str, h5py.Dataset] = {}  # Opening a column takes longer than reading a number of it.

    def __len__(self) -> int:
        return int(self._data.shape[0])

    def row(self, index: int) -> NDArray[Any]:
        """Return the array of one measurement."""
        row = np.asarray(self._data[index])
        wanted, got = int(self.column("crc32", index)), zlib.crc32(row.data)
        if got != wanted:
            raise DamagedError(
                f"{self._name} {index} has CRC-32 {got:08x}, but the file states {wanted:08x}: the file is "
                "damaged; copy it again"
            )
        return row

    def stamp(self, index: int, sensor: str) -> Stamp:
        """Return the stamp of one measurement."""
        fields = {field: self.column(name, index) for name, field in _STAMP_FIELDS.items()}
        code = self.column("behaviour", index) if "behaviour" in self._group else -1
        return Stamp(sensor=sensor, behaviour=_behaviour(code, index), **fields)

    def stamps(self, sensor: str) -> list[Stamp]:
        """Return the stamps of all measurements."""
        columns = (self._group[name][:].tolist() for name in _STAMP_FIELDS)
        codes = self._group["behaviour"][:].tolist() if "behaviour" in self._group else [-1] * len(self)
        return [
            Stamp(
                sensor=sensor,
                behaviour=_behaviour(code, index),
                **dict(zip(_STAMP_FIELDS.values(), row, strict=True)),
            )
            for index, (code, *row) in enumerate(zip(codes, *columns, strict=True))
        ]

    def column(self, name: str, index: int) -> Any:
        """Return the number of one measurement in a column."""
        if name not in self._columns:
            self._columns[name] = self._group[name]
        return self._columns[name][index].item()


def _behaviour(code: int, index: int) -> Behaviour:
    """Return the behaviour of a measurement by its code in the file."""
    if code not in _BEHAVIOURS:
        known = ", ".join(f"{number} ({name})" for number, name in _BEHAVIOURS.items())
        raise DamagedError(
            f"measurement {index} has behaviour {code}, but the format knows {known}: the file is damaged; copy it "
            "again"
        )
    return _BEHAVIOURS[code]
