"""Recordings: measurements as recorded, with everything that processing needs."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DamagedError, DataError
from ertis_numba.base.notebook_html import shown_in_notebooks
from ertis_numba.frames import Measurement, SequenceGap, Trajectory
from ertis_numba.frames.pose_doubts import warn_of_poses
from ertis_numba.frames.sample_format import SampleFormat, sample_format
from ertis_numba.geometry import microphones, mounting as mounted, self_contained, storable
from ertis_numba.settings import Air, Settings
from ertis_numba.storage._mounting import read_mounting
from ertis_numba.storage._poses import (
    POSE_SIZES,
    Poses,
    checked_poses,
    poses_of,
    read_poses,
    require_times,
    write_poses,
)
from ertis_numba.storage._reader import FileReader
from ertis_numba.storage._rows import RowWriter
from ertis_numba.storage._writer import FileWriter
from ertis_numba.storage.opening import Source
from ertis_numba.storage.recording_variables import (
    AIR,
    axis_sizes,
    create_sensor_variables,
    data_and_table,
    layout_arrays,
)
from ertis_numba.storage.schema import FORMAT_VERSION, POSES, RECORDING, Variable
from ertis_numba.storage.truth import GroundTruth, GroundTruthLog
from ertis_numba.storage.variables import to_python

__all__ = ["JOURNAL_DAMAGE", "RecordingReader", "RecordingWriter", "open_recording", "write_recording"]

JOURNAL_DAMAGE = "journal_damage"
"""Attribute of a recording: losses of its journal that no gap covers."""

Mounting = tuple[Sequence[float], Sequence[float]]
"""Position of a sensor, x, y, z in m, and its orientation, a unit quaternion x, y, z, w."""


class RecordingReader(FileReader[Measurement]):
    """A recording as a sequence of measurements, read on access.

    Attributes
    ----------
    gaps : tuple of SequenceGap
        Missing sequence numbers with their reasons.
    firmware : str
        Version of the sensor's firmware; empty if unknown.
    translation_m : (3,) float64, or None
        Position of the sensor on its platform, in metres; None if the mounting is unknown.
    rotation_xyzw : (4,) float64, or None
        Unit quaternion that rotates the sensor frame into the platform frame; None if the mounting is unknown.
    trajectory : Trajectory or None
        Poses of the platform at the times of the measurements; None if they are unknown. If some measurements have no
        pose, its `max_gap_s` is 1.
    """

    _kind: ClassVar[str] = "recording"

    gaps: tuple[SequenceGap, ...]
    firmware: str
    translation_m: NDArray[np.float64] | None
    rotation_xyzw: NDArray[np.float64] | None
    trajectory: Trajectory | None

    _repr_html_ = shown_in_notebooks

    def _select_table(self) -> None:
        self._data, table = data_and_table(pdm="pcm" not in self._group)
        self._table = (*table, *POSES)

    def _load(self) -> None:
        self._require_agreement()
        names = ("gap_first", "gap_last", "gap_reason", "gap_session_id")
        columns = (self._group[name][:].tolist() for name in names)
        try:
            self.gaps = tuple(
                SequenceGap(self.sensor, first, last, reason.decode(), session_id)
                for first, last, reason, session_id in zip(*columns, strict=True)
            )
        except ArgumentError as error:
            problem = str(error).partition(";")[0]
            raise DamagedError(f"a gap of sensor {self.sensor} is damaged ({problem}); copy it again") from error
        self.firmware = str(to_python(self._group.attrs["firmware"]))
        self.translation_m, self.rotation_xyzw = read_mounting(self._group, self.path)
        self.trajectory = read_poses(self._group, self.path)

    def _item(self, index: int) -> Measurement:
        air = Air(**{field: self._rows.column(name, index) for name, field in AIR.items()})
        settings = self.settings if air == self.settings.air else self.settings.replace(air=air)
        return Measurement(self._rows.row(index), settings, self._rows.stamp(index, self.sensor))

    def _sizes(self) -> dict[str, int]:
        return {**axis_sizes(self.settings), **POSE_SIZES}

    def _require_agreement(self) -> None:
        """Refuse a file whose arrays contradict its settings, which processing uses."""
        came, words = self._group[self._data].dtype, sample_format(self.settings)
        if came != words.dtype:
            raise DataError(
                f"{self.path}: {self._data} contains {came}, but the settings in the file give {words.dtype} "
                f"(recording.encoding {self.settings.recording.encoding!r}); change the settings with it"
            )
        for name, wanted in layout_arrays(microphones(self.settings.array)).items():
            values = self._group[name][:]
            wrong = np.argwhere(values != wanted)  # This includes NaN.
            if wrong.size:
                place = tuple(wrong[0])
                raise DataError(
                    f"{self.path}: {name} of channel {place[0]} is {values[place]:g}, but the settings in the "
                    f"file give {wanted[place]:g}; change the settings with it"
                )


def open_recording(path: Source, *, sensor: str | None = None) -> RecordingReader:
    """Open a recording for reading.

    Parameters
    ----------
    path : str, Path or binary file
        Path of the file, or a file object that can seek, as from `fsspec.open`, to read parts of remote files.
    sensor : str, optional
        Name of the sensor; required if the file contains several.

    Raises
    ------
    DataError
        The file is not a recording, is damaged or truncated.
    FormatVersionError
        A newer version of this package wrote the file.
    ArgumentError
        The file does not contain this sensor, or contains several and none is given.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     recording[0].stamp.sequence
    0
    """
    return RecordingReader(path, sensor=sensor)


class RecordingWriter(FileWriter[Measurement]):
    """Writer of a recording, one measurement at a time; use it in a ``with`` statement.

    Measurements of several sensors may come in any order.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    settings : Settings, optional
        Settings of a recording of one sensor; by default those of the first measurement of each sensor. The content of
        layout files is stored in the recording.
    overwrite : bool
        Replace an existing file.
    source : str
        Origin of the measurements.
    truth : mapping of str to GroundTruth or GroundTruthLog, optional
        Ground truth of each simulated sensor, by name. A log may grow while measurements are written.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Mounting of each sensor on its platform, by name: x, y, z in metres, and the unit quaternion x, y, z, w that
        rotates the sensor frame into the platform frame. Unknown by default.
    firmware : mapping of str to str, optional
        Version of each sensor's firmware, by name.
    poses : Trajectory, or mapping of str to Trajectory, optional
        Trajectory of the platform, or of each sensor's platform, by name of the sensor. The recording stores the pose
        at each measurement, which the trajectory must cover unless it has a `max_gap_s`. Unknown by default.

    Warns
    -----
    PoseWarning
        Poses are hardly those of a platform, as for `add_poses`.
    """

    _kind: ClassVar[str] = "recording"
    _data: str = "pdm"
    _table: tuple[Variable, ...] = (*RECORDING, *POSES)
    _numbered: ClassVar[bool] = True

    def __init__(
        self,
        path: str | Path,
        *,
        settings: Settings | None = None,
        overwrite: bool = False,
        source: str = "",
        truth: Mapping[str, GroundTruth | GroundTruthLog] | None = None,
        mounting: Mapping[str, Mounting] | None = None,
        firmware: Mapping[str, str] | None = None,
        poses: Poses | None = None,
    ) -> None:
        super().__init__(path, overwrite=overwrite, attributes={"source": source, "history": ""}, truth=truth)
        self._given = settings
        self._settings: dict[str, Settings] = {}
        self._checked: dict[str, Settings] = {}
        self._formats: dict[str, SampleFormat] = {}
        self._mounting = {sensor: mounted(sensor, *given) for sensor, given in (mounting or {}).items()}
        self._firmware = firmware or {}
        self._noted: dict[str, list[SequenceGap]] = {}
        self._poses = checked_poses(poses)
        self._warn_of_poses()

    def _warn_of_poses(self) -> None:
        several = self._poses.values() if isinstance(self._poses, Mapping) else [self._poses]
        for each in several:
            if each is not None:
                warn_of_poses(each, stacklevel=3)

    def note_gap(self, sensor: str, first: int, last: int, reason: str, session_id: int = 0) -> None:
        """Store why sequence numbers are missing, ``first`` and ``last`` included; in any order, at any time.

        They may also lie before the first measurement of the sensor or after its last one. A number that arrives after
        all is not a gap. Gaps without a noted reason have the reason "not among the measurements given".
        ``session_id`` is that of the stamps, by default 0.

        Raises
        ------
        ArgumentError
            ``last`` comes before ``first``, or the reason is not a line of at most 64 bytes.
        """
        self._noted.setdefault(sensor, []).append(SequenceGap(sensor, first, last, reason, session_id))

    def _begin(self, group: h5py.Group, first: Measurement) -> None:
        sensor = first.stamp.sensor
        if self._given is not None and self._settings:
            raise ArgumentError(
                f"settings are given for one sensor, but there are measurements of {', '.join(self._settings)} "
                f"and {sensor}; remove settings, so that each sensor keeps its own"
            )
        given = self._given or first.settings
        settings = self._settings[sensor] = storable(given)
        self._formats[sensor] = sample_format(settings)
        create_sensor_variables(
            group,
            settings,
            firmware=self._firmware.get(sensor, ""),
            mounting=self._mounting.get(sensor, {}),
        )

    def _row(self, item: Measurement) -> tuple[NDArray[Any], dict[str, float]]:
        self._require_same(item.stamp.sensor, item.settings)
        self._require_samples(item)
        trajectory = poses_of(self._poses, item.stamp.sensor)
        if trajectory is not None:  # The error comes before the rest of a long recording.
            require_times(trajectory, np.array([item.stamp.timestamp_ns]), item.stamp.sensor)
        air = item.settings.air
        return item.data, {name: getattr(air, field) for name, field in AIR.items()}

    def _require_same(self, sensor: str, settings: Settings) -> None:
        """Refuse settings that differ from the first in more than the air."""
        if settings is self._checked.get(sensor):
            return
        came = self_contained(settings)
        for name in ("array", "call", "recording"):
            if getattr(came, name) != getattr(self._settings[sensor], name):
                raise ArgumentError(
                    f"a measurement has other {name} settings than the recording; write it to its own recording"
                )
        self._checked[sensor] = settings

    def _require_samples(self, item: Measurement) -> None:
        """Refuse samples of another type, and samples that no pipeline accepts."""
        name, wanted = f"measurement {len(self._rows[item.stamp.sensor])}", self._formats[item.stamp.sensor].dtype
        if not np.can_cast(item.data.dtype, wanted, "equiv"):  # This allows another byte order.
            raise ArgumentError(
                f"{name} contains {item.data.dtype} samples, but its settings state {wanted.name}; convert them, "
                "or use the settings of the recording"
            )
        if wanted.kind == "f":
            checks.finite_array(name, item.data)

    def _finish(self, file: h5py.File) -> None:
        super()._finish(file)
        poses = self._poses if isinstance(self._poses, Mapping) else {}
        data = {"mounting": self._mounting, "firmware": self._firmware, "a gap": self._noted, "poses": poses}
        for name, given in data.items():
            self._require_sensors(name, given)

    def _data_of(self, group: h5py.Group) -> str:
        data, _ = data_and_table(pdm="pdm" in group)
        return data

    def _complete(self, group: h5py.Group, rows: RowWriter) -> None:
        sensor = group.name.rpartition("/")[2]
        gaps = rows.runs.missing(sensor, self._noted.get(sensor, ()))
        values: dict[str, list[Any]] = {
            "gap": [0.0] * len(gaps),
            "gap_first": [gap.first for gap in gaps],
            "gap_last": [gap.last for gap in gaps],
            "gap_reason": [gap.reason.encode() for gap in gaps],
            "gap_session_id": [gap.session_id for gap in gaps],
        }
        for name, column in values.items():
            variable = group[name]
            variable.resize((len(gaps),))
            if len(column):
                variable[:] = column
                variable.flush()  # As for rows: see `RowWriter.flush`.
        trajectory = poses_of(self._poses, sensor)
        if trajectory is not None:
            write_poses(group, trajectory)
            self._format_version = FORMAT_VERSION


def write_recording(
    path: str | Path,
    measurements: Iterable[Measurement],
    *,
    settings: Settings | None = None,
    overwrite: bool = False,
    source: str = "",
    truth: Mapping[str, GroundTruth | GroundTruthLog] | None = None,
    mounting: Mapping[str, Mounting] | None = None,
    poses: Poses | None = None,
) -> Path:
    """Write a recording.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    measurements : iterable of Measurement
        Measurements of one or several sensors. It is read one measurement at a time.
    settings, overwrite, source, truth, mounting
        See `RecordingWriter`.
    poses : Trajectory, or mapping of str to Trajectory, optional
        See `RecordingWriter`; by default those of ``measurements`` if it is a `RecordingReader`.

    Returns
    -------
    Path
        The path.

    Raises
    ------
    ArgumentError
        There is no measurement, one does not match the others or its settings, repeats a sequence number, or contains
        NaN or infinity; or the file exists.
    DataError
        The disk is full or not writable.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     path = ertis.write_recording("copy.h5", recording, overwrite=True)
    """
    if isinstance(measurements, RecordingReader):
        poses = measurements.trajectory if poses is None else poses
        if mounting is None and measurements.translation_m is not None and measurements.rotation_xyzw is not None:
            place = measurements.translation_m.tolist(), measurements.rotation_xyzw.tolist()
            mounting = {measurements.sensor: place}
    with RecordingWriter(
        path, settings=settings, overwrite=overwrite, source=source, truth=truth, mounting=mounting, poses=poses
    ) as writer:
        for measurement in checks.items("measurements", measurements, Measurement, "a recording contains"):
            writer.write(measurement)
    return writer.path
