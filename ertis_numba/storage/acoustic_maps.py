"""Files of acoustic maps: sound power over direction and band, with their axes."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import DamagedError
from ertis_numba.frames import AcousticMap, Bearing, known_levels
from ertis_numba.settings import Settings
from ertis_numba.storage._results import ResultFile, ResultReader, ResultWriter
from ertis_numba.storage._rows import RowWriter
from ertis_numba.storage.opening import Source
from ertis_numba.storage.recording import Mounting, RecordingReader
from ertis_numba.storage.schema import ACOUSTIC_MAP, BEARINGS, POSES, Variable
from ertis_numba.storage.variables import create_variables, set_attributes, to_python

__all__ = [
    "AcousticMapReader",
    "AcousticMapWriter",
    "BearingReader",
    "open_acoustic_maps",
    "write_acoustic_maps",
    "write_bearings",
]

BEARING_SIZES: Final = {"angle": 2, "edge": 2}
"""Lengths of the axes of bearings."""
_DOUBTS: Final = ("may_be_crosstalk", "may_be_interference")  # by the number of their bit
_FIELDS: Final[dict[str, tuple[str, ...]]] = {
    "bearing_direction": ("azimuth_deg", "elevation_deg"),
    "bearing_uncertainty": ("sideways_deg", "upwards_deg"),
    "bearing_correlation": ("correlation",),
    "bearing_band": ("band_hz",),
    "bearing_level": ("level_dbfs",),
    "bearing_snr": ("snr_db",),
}


def write_bearings(group: h5py.Group, found: Sequence[tuple[Bearing, ...]]) -> None:
    """Store the bearings of all maps of a sensor, in the order of the maps."""
    every = [each for bearings in found for each in bearings]
    columns: dict[str, Any] = {
        name: [[getattr(each, field) for field in fields] for each in every] for name, fields in _FIELDS.items()
    }
    columns["bearing_doubts"] = [
        sum(getattr(each, field) << bit for bit, field in enumerate(_DOUBTS)) for each in every
    ]
    create_variables(group, BEARINGS, sizes={"bearing": len(every), **BEARING_SIZES})
    group["bearing_count"].resize(len(found), axis=0)
    columns["bearing_count"] = [len(bearings) for bearings in found]
    for name, values in columns.items():
        group[name][...] = np.reshape(values, group[name].shape)
        group[name].flush()


class BearingReader:
    """Bearings of the maps of a sensor, by the number of a map."""

    def __init__(self, group: h5py.Group, path: Path, settings: Settings) -> None:
        missing = [variable.name for variable in BEARINGS if variable.name not in group]
        if missing:
            raise DamagedError(f"{path}: bearings of acoustic maps lack {', '.join(missing)}; copy the file again")
        self._bounds = np.concatenate([[0], np.cumsum(group["bearing_count"][:], dtype=np.int64)])
        self._settings = settings
        self._columns: dict[str, Any] = {name: group[name][:] for name in (*_FIELDS, "bearing_doubts")}
        if {len(column) for column in self._columns.values()} != {int(self._bounds[-1])}:
            raise DamagedError(f"{path}: bearing_count does not match the number of bearings; copy the file again")

    def __call__(self, index: int) -> tuple[Bearing, ...]:
        """Return the bearings of a map."""
        return tuple(self._bearing(row) for row in range(self._bounds[index], self._bounds[index + 1]))

    def _bearing(self, row: int) -> Bearing:
        fields: dict[str, Any] = {}
        for name, fields_of in _FIELDS.items():
            values = np.atleast_1d(self._columns[name][row]).tolist()
            fields |= zip(fields_of, [tuple(values)] if name == "bearing_band" else values, strict=True)
        doubts = int(self._columns["bearing_doubts"][row])
        fields |= {field: bool(doubts >> bit & 1) for bit, field in enumerate(_DOUBTS)}
        fields |= known_levels(self._settings, math.sqrt(math.prod(fields["band_hz"])), fields["level_dbfs"])
        return Bearing(**fields)


class _AcousticMapFile(ResultFile):
    _kind: ClassVar[str] = "acoustic_map"
    _data: str = "power"
    _values: ClassVar[str] = "power"
    _table: tuple[Variable, ...] = (*ACOUSTIC_MAP, *BEARINGS, *POSES)
    _type: ClassVar[type[Any]] = AcousticMap
    _name: ClassVar[str] = "an acoustic map"
    _axes: ClassVar[Mapping[str, str]] = {
        "azimuth": "azimuth_rad",
        "elevation": "elevation_rad",
        "band_edge": "band_hz",
    }
    _columns: ClassVar[Mapping[str, str]] = {
        "n_measurements": "n_measurements",
        "n_blocks": "n_blocks",
        "masked": "masked_s",
        "false_alarm": "false_alarm",
    }
    _lengths: ClassVar[Mapping[str, int | str]] = {"direction": "azimuth", "band": "band_edge", "edge": 2}


class AcousticMapWriter(_AcousticMapFile, ResultWriter[AcousticMap]):
    """Writer of a file of acoustic maps, one map at a time; use it in a ``with`` statement.

    Maps of several sensors may come in any order.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    recording : RecordingReader or sequence of RecordingReader, optional
        Recording of the maps: one reader, or one for each sensor of the same recording. The file stores its UUID and
        SHA-256, and the pose at the last measurement of each map.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Mounting by name of the sensor, as for `RecordingWriter`, instead of that of the recording. By default, the file
        stores the mountings that the recording contains.
    overwrite : bool
        Replace an existing file.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        recording: RecordingReader | Sequence[RecordingReader] | None = None,
        mounting: Mapping[str, Mounting] | None = None,
        overwrite: bool = False,
    ) -> None:
        super().__init__(path, recording=recording, mounting=mounting, dtype="float32", overwrite=overwrite)
        self._band_notes: dict[str, str] = {}
        self._bearings: dict[str, list[tuple[Bearing, ...]]] = {}

    def note_bands(self, sensor: str, band_note: str) -> None:
        """Store a note on sound that the bands of a sensor's maps do not show: `AcousticCamera.band_note`.

        Call this before the file is closed.
        """
        self._band_notes[sensor] = band_note

    def _row(self, item: AcousticMap) -> tuple[NDArray[Any], dict[str, float]]:
        row = super()._row(item)
        self._bearings.setdefault(item.stamp.sensor, []).append(item.bearings)
        return row

    def _complete(self, group: h5py.Group, rows: RowWriter) -> None:
        sensor = group.name.rpartition("/")[2]
        write_bearings(group, self._bearings[sensor])
        super()._complete(group, rows)
        note = self._band_notes.get(sensor)
        if note:
            set_attributes(group, {"band_note": note})


class AcousticMapReader(_AcousticMapFile, ResultReader[AcousticMap]):
    """File of acoustic maps as a sequence of them, each read when it is indexed.

    The properties ``azimuth_deg`` and ``elevation_deg`` are the angles in degrees.

    Attributes
    ----------
    azimuth_rad, elevation_rad : (direction,) float64
        Directions in the sensor frame, in radians.
    band_hz : (band, 2) float64
        Lower and upper edge of each band in hertz.
    n_measurements : (map,) int64
        Measurements in each map.
    translation_m : (3,) float64, or None
        Position of the sensor in metres; None if its mounting is unknown.
    rotation_xyzw : (4,) float64, or None
        Unit quaternion that rotates the sensor frame into the platform frame; None if the mounting is unknown.
    trajectory : Trajectory, or None
        Pose of the platform at the last measurement of each map, by increasing time; None if the poses are unknown.
    band_note : str
        Note on sound that the bands of the maps do not show, or only in part; empty if there is none.
    """

    _row_name: ClassVar[str] = "acoustic map"

    band_hz: NDArray[np.float64]
    n_measurements: NDArray[np.int64]
    band_note: str

    def _load(self) -> None:
        super()._load()
        self.n_measurements = np.asarray(self._group["n_measurements"][:])
        self.band_note = str(to_python(self._group.attrs.get("band_note", "")))
        is_searched = "false_alarm" in self._group and np.isfinite(self._group["false_alarm"][:]).all()
        self._bearings = BearingReader(self._group, self.path, self.settings) if is_searched else None

    @property
    def has_bearings(self) -> bool:
        """True if the bearings of sources were searched in all maps."""
        return self._bearings is not None

    def _item(self, index: int) -> AcousticMap:
        found = super()._item(index)
        return found if self._bearings is None else found.replace(bearings=self._bearings(index))

    def _sizes(self) -> dict[str, int]:
        return super()._sizes() | BEARING_SIZES


def open_acoustic_maps(path: Source, *, sensor: str | None = None) -> AcousticMapReader:
    """Open a file of acoustic maps for reading.

    Parameters
    ----------
    path : str, Path or binary file
        As for `open_recording`.
    sensor : str, optional
        Name of the sensor, if the file contains several.

    Raises
    ------
    DataError
        The file does not contain acoustic maps, is damaged or truncated.
    FormatVersionError
        A newer version wrote the file.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     maps = list(ertis.AcousticCamera(recording.settings).process_many(recording))
    >>> path = ertis.write_acoustic_maps("maps.h5", maps, overwrite=True)
    >>> with ertis.open_acoustic_maps(path) as reader:
    ...     len(reader) == len(maps)
    True
    """
    return AcousticMapReader(path, sensor=sensor)


def write_acoustic_maps(
    path: str | Path,
    maps: Iterable[AcousticMap],
    *,
    recording: RecordingReader | Sequence[RecordingReader] | None = None,
    mounting: Mapping[str, Mounting] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a file of acoustic maps.

    Parameters
    ----------
    path : str or Path
    maps : iterable of AcousticMap
        Maps of one or several sensors. It is read one map at a time.
    recording, mounting, overwrite
        See `AcousticMapWriter`.

    Returns
    -------
    Path
        The path.

    Raises
    ------
    ArgumentError
        There is no map, settings or axes of a sensor's maps differ, or the file exists.
    DataError
        The disk is full or cannot be written.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     camera = ertis.AcousticCamera(recording.settings)
    ...     path = ertis.write_acoustic_maps("maps.h5", camera.process_many(recording), overwrite=True)
    """
    with AcousticMapWriter(path, recording=recording, mounting=mounting, overwrite=overwrite) as writer:
        for each in checks.items("maps", maps, AcousticMap, "AcousticCamera.process returns"):
            writer.write(each)
    return writer.path
