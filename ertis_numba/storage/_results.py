"""Base classes of the files of results: images or maps of a recording, with their axes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.base.atomic_files import check_target
from ertis_numba.base.errors import ArgumentError, DamagedError
from ertis_numba.frames import AcousticMap, Energyscape, Trajectory
from ertis_numba.geometry import mounting as mounted, self_contained
from ertis_numba.storage._mounting import read_mounting, write_mounting
from ertis_numba.storage._poses import POSE_SIZES, read_poses, write_poses
from ertis_numba.storage._reader import FileReader
from ertis_numba.storage._rows import RowWriter
from ertis_numba.storage._writer import FileWriter
from ertis_numba.storage.recording import Mounting, RecordingReader
from ertis_numba.storage.schema import BEARINGS, FORMAT_VERSION, POINTS, POSES, Variable
from ertis_numba.storage.truth import GroundTruth
from ertis_numba.storage.variables import create_variables, set_attributes

__all__ = ["ResultFile", "ResultReader", "ResultWriter", "provenance", "recorded_mountings"]

_LEVEL_COMMENT: Final = (
    "relative to the horizontal plane and to the heading of the sensor (processing.level_directions)"
)

Result = TypeVar("Result", Energyscape, AcousticMap)


class ResultFile:
    """Declaration of a kind of file, which its writer and its reader inherit.

    ``_kind``, ``_data`` and ``_table`` are as for `FileWriter`; the table ends with the variables of poses. ``_type``
    is the class of a row, ``_values`` the field of its array, and ``_name`` its name in errors, with its article.
    ``_axes`` has the field of a row by the variable that stores it once, and ``_columns`` by the variable with one
    number per row. ``_lengths`` has the length of each axis of the table: a number, or a variable that has this first
    axis.
    """

    _kind: ClassVar[str]
    _data: str
    _values: ClassVar[str]
    _table: tuple[Variable, ...]
    _type: ClassVar[type[Any]]
    _name: ClassVar[str]
    _axes: ClassVar[Mapping[str, str]]
    _columns: ClassVar[Mapping[str, str]] = {}
    _lengths: ClassVar[Mapping[str, int | str]]

    def _sizes_of(self, axes: Mapping[str, Any]) -> dict[str, int]:
        """Return the length of each axis, from the values of the variables in ``_axes``."""
        return {
            name: length if isinstance(length, int) else len(axes[length]) for name, length in self._lengths.items()
        }


class ResultWriter(ResultFile, FileWriter[Result]):
    """Writer of results, one at a time; `EnergyscapeWriter` describes the parameters."""

    _numbered: ClassVar[bool] = False

    def __init__(
        self,
        path: str | Path,
        *,
        recording: RecordingReader | Sequence[RecordingReader] | None,
        mounting: Mapping[str, Mounting] | None,
        dtype: str,
        overwrite: bool,
        truth: Mapping[str, GroundTruth] | None = None,
    ) -> None:
        readers = [recording] if isinstance(recording, RecordingReader) else [*(recording or ())]
        check_target(Path(path), overwrite=overwrite, sources=[reader.path for reader in readers])
        super().__init__(path, overwrite=overwrite, attributes=provenance(readers), truth=truth)
        self._readers = readers
        self._dtype = np.dtype(dtype).newbyteorder("<").str
        self._first: dict[str, Result] = {}
        self._given = {sensor: mounted(sensor, *given) for sensor, given in (mounting or {}).items()}
        self._mounting = recorded_mountings(readers) | self._given
        self._trajectories = {reader.sensor: reader.trajectory for reader in readers if reader.trajectory is not None}

    def note_mounting(self, sensor: str, translation_m: Sequence[float], rotation_xyzw: Sequence[float]) -> None:
        """Set the mounting of a sensor.

        Call this before the sensor's first row is written; later calls have no effect.

        Raises
        ------
        ArgumentError
            A number is missing or not finite, or the length of the quaternion is not 1.
        """
        self._given[sensor] = self._mounting[sensor] = mounted(sensor, translation_m, rotation_xyzw)

    def _begin(self, group: h5py.Group, first: Result) -> None:
        sensor = first.stamp.sensor
        self._first[sensor] = first
        axes = {name: getattr(first, field) for name, field in self._axes.items()}
        create_variables(
            group,
            [variable for variable in self._table if variable not in (*BEARINGS, *POINTS, *POSES)],
            sizes=self._sizes_of(axes),
            dtypes={self._data: self._dtype},
            texts={"settings": self_contained(first.settings).to_toml()},
        )
        write_mounting(group, self._mounting.get(sensor, {}))
        for name, values in axes.items():
            group[name][:] = values
        set_attributes(group[self._data], {"coordinates": "azimuth elevation"})
        if first.settings.processing.level_directions:
            for name in ("azimuth", "elevation"):
                set_attributes(group[name], {"comment": _LEVEL_COMMENT})

    def _row(self, item: Result) -> tuple[NDArray[Any], dict[str, float]]:
        first = self._first[item.stamp.sensor]
        if item.settings is not first.settings and item.settings != first.settings:
            raise ArgumentError(
                f"the settings of {self._name} differ from those of the first item; write this item to another file"
            )
        for field in self._axes.values():
            ours, theirs = getattr(item, field), getattr(first, field)
            if ours is not theirs and not np.array_equal(ours, theirs):
                raise ArgumentError(f"{field} of {self._name} differs from that of the first; write it to another file")
        return getattr(item, self._values), {name: getattr(item, field) for name, field in self._columns.items()}

    def _finish(self, file: h5py.File) -> None:
        super()._finish(file)
        self._require_sensors("mounting", self._given)

    def _complete(self, group: h5py.Group, rows: RowWriter) -> None:
        super()._complete(group, rows)
        trajectory = self._trajectories.get(group.name.rpartition("/")[2])
        if trajectory is not None:
            write_poses(group, trajectory)
            self._format_version = FORMAT_VERSION


class ResultReader(ResultFile, FileReader[Result], DegreesFromRadians):
    """File of results as a sequence of them; `EnergyscapeReader` describes the attributes."""

    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]
    translation_m: NDArray[np.float64] | None
    rotation_xyzw: NDArray[np.float64] | None
    trajectory: Trajectory | None

    @property
    def dtype(self) -> str:
        """Name of the type in which the file stores rows."""
        return str(self._group[self._data].dtype.name)

    def check_rows(self) -> None:
        """Read all rows.

        Raises
        ------
        DamagedError
            A row does not match its CRC-32.
        """
        with self._reading():
            for index in range(len(self)):
                self._rows.row(index)

    def _load(self) -> None:
        for name, field in self._axes.items():
            setattr(self, field, np.asarray(self._group[name][:]))
        self.translation_m, self.rotation_xyzw = read_mounting(self._group, self.path)
        self.trajectory = read_poses(self._group, self.path)

    def _sizes(self) -> dict[str, int]:
        return {**self._sizes_of(self._group), **POSE_SIZES}

    def _values_of(self, row: NDArray[Any]) -> NDArray[np.float32]:
        """Return the array of a row as stored in single precision."""
        return row.astype(np.float32, copy=False)

    def _item(self, index: int) -> Result:
        fields = {
            self._values: self._values_of(self._rows.row(index)),
            **{field: getattr(self, field) for field in self._axes.values()},
            **{field: self._rows.column(name, index) for name, field in self._columns.items() if name in self._group},
        }
        try:
            made: Result = self._type(**fields, settings=self.settings, stamp=self._rows.stamp(index, self.sensor))
        except ArgumentError as error:
            raise DamagedError(f"{self.path}: {self._row_name} {index}: {error}") from error
        return made


def provenance(readers: Sequence[RecordingReader]) -> dict[str, str]:
    """Return the attributes of a file that describe its recording."""
    if not readers:
        return {"source": "", "history": ""}
    first = readers[0]
    for reader in readers:
        if reader.uuid != first.uuid:
            raise ArgumentError(f"{reader.path} is not the same recording as {first.path}; write one file for each")
    return {
        "source": first.path.name,
        "history": f"processed from recording {first.uuid}",
        "recording_uuid": first.uuid,
        "recording_sha256": first.sha256(),
    }


def recorded_mountings(readers: Sequence[RecordingReader]) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Return the known mountings by name of the sensor, in the form of `ertis_numba.geometry.mounting`."""
    return {
        reader.sensor: mounted(reader.sensor, reader.translation_m.tolist(), reader.rotation_xyzw.tolist())
        for reader in readers
        if reader.translation_m is not None and reader.rotation_xyzw is not None
    }
