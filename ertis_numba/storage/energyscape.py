"""Energyscape files: images of a recording, with their axes."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.constants import IMAGE_DTYPES, ImageDtype
from ertis_numba.base.errors import ArgumentError, DamagedError
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.frames.level_codes import MAX_STEP_DB
from ertis_numba.storage._levels import encoded, levels_for, levels_of, stored_levels
from ertis_numba.storage._points import POINT_SIZES, PointReader, require_uniform, write_points
from ertis_numba.storage._results import ResultFile, ResultReader, ResultWriter
from ertis_numba.storage._rows import RowReader, RowWriter
from ertis_numba.storage.opening import Source
from ertis_numba.storage.recording import Mounting, RecordingReader
from ertis_numba.storage.schema import (
    ENERGYSCAPE,
    ENERGYSCAPE_OF_LEVELS,
    FORMAT_VERSION,
    LEVELS,
    POINTS,
    POSES,
    Variable,
)
from ertis_numba.storage.truth import GroundTruth, GroundTruthLog
from ertis_numba.storage.variables import set_attributes, to_python

if TYPE_CHECKING:
    from ertis_numba.frames.level_codes import LevelCodes

__all__ = ["EnergyscapeReader", "EnergyscapeWriter", "open_energyscapes", "write_energyscapes"]

_ERRORS_DB: Final = ("predicted_error_db", "max_error_db", "wavefront_error_db")
PLATFORM_FRAME: Final = "base_link"  # Sensor of fused images; the fusion lies above this package.
_TEXTS: Final = (
    "budget_applies_to",
    "error_warning",
    "call_warning",
    "start_warning",
    "layout_warning",
    "samples_warning",
)


class _EnergyscapeFile(ResultFile):
    _kind: ClassVar[str] = "energyscape"
    _data: str = "amplitude"
    _values: ClassVar[str] = "amplitude"
    _table: tuple[Variable, ...] = (*ENERGYSCAPE, *POINTS, *POSES)
    _type: ClassVar[type[Any]] = Energyscape
    _name: ClassVar[str] = "an energyscape"
    _axes: ClassVar[Mapping[str, str]] = {"azimuth": "azimuth_rad", "elevation": "elevation_rad", "range": "range_m"}
    _lengths: ClassVar[Mapping[str, int | str]] = {"direction": "azimuth", "range": "range"}

    def _choose_table(self, *, is_levels: bool) -> None:
        """Choose the variable of the images."""
        self._is_levels = is_levels
        if is_levels:
            self._data, self._table = LEVELS.name, (*ENERGYSCAPE_OF_LEVELS, *POINTS, *POSES)


class EnergyscapeWriter(_EnergyscapeFile, ResultWriter[Energyscape]):
    """Writer of an energyscape file, one image at a time; use it in a ``with`` statement.

    Energyscapes of several sensors may come in any order.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    recording : RecordingReader or sequence of RecordingReader, optional
        Recording of the images: one reader, or one for each sensor of the same recording. The file stores its UUID and
        SHA-256, and the poses and the ground truth of the measurements. Images in level directions have no ground
        truth, because it is in the frame of the sensor.
    truth : mapping of str to GroundTruth, optional
        Ground truth by name of the sensor, instead of that of the recording.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Mounting by name of the sensor, as for `RecordingWriter`, instead of that of the recording. By default, the file
        stores the mountings that the recording contains.
    dtype : {"float32", "float16", "uint8"}
        Type of the stored images. float16 halves the file; it has three digits down to -84 dBFS and fewer below.
        netCDF programs cannot read it. uint8 stores levels in steps of 0.5 dB, in a quarter of the bytes, usually from
        -122 to 5 dBFS. The first image of a sensor selects other limits if it is louder or very quiet.
    overwrite : bool
        Replace an existing file.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        recording: RecordingReader | Sequence[RecordingReader] | None = None,
        truth: Mapping[str, GroundTruth] | None = None,
        mounting: Mapping[str, Mounting] | None = None,
        dtype: ImageDtype = "float32",
        overwrite: bool = False,
    ) -> None:
        checks.choice("dtype", dtype, IMAGE_DTYPES)
        self._levels: dict[str, LevelCodes] = {}
        super().__init__(path, recording=recording, mounting=mounting, dtype=dtype, overwrite=overwrite, truth=truth)
        self._choose_table(is_levels=dtype == "uint8")
        self._points: dict[str, list[PointCloud]] = {}
        self._stated: dict[str, dict[str, float | str]] = {}
        self._recorded = {reader.sensor: (reader.truth, reader.stamps()) for reader in self._readers if reader.truth}

    def note_error(
        self,
        sensor: str,
        *,
        predicted_error_db: float,
        max_error_db: float,
        budget_applies_to: Literal["image", "echoes", "beams"],
        error_warning: str,
    ) -> None:
        """Store the predicted error of a sensor's images, the budget, its scope, and a warning if images may exceed it.

        Call this before the sensor's first energyscape is written.

        Raises
        ------
        ArgumentError
            An error is not a finite number.
        """
        for name, value in (("predicted_error_db", predicted_error_db), ("max_error_db", max_error_db)):
            if not math.isfinite(value):
                raise ArgumentError(f"{name} is {value}; use a finite number of decibels")
        self._state(
            sensor,
            predicted_error_db=predicted_error_db,
            max_error_db=max_error_db,
            budget_applies_to=budget_applies_to,
            error_warning=error_warning,
        )

    def note_call(self, sensor: str, call_warning: str) -> None:
        """Store a warning that echoes do not match the call, or that it could not be checked; empty if they match.

        Call this before the sensor's first energyscape is written.
        """
        self._state(sensor, call_warning=call_warning)

    def note_start(self, sensor: str, start_warning: str) -> None:
        """Store a warning that a sensor's records do not begin with the emission; empty if they may.

        Call this before the sensor's first energyscape is written.
        """
        self._state(sensor, start_warning=start_warning)

    def note_layout(self, sensor: str, layout_warning: str) -> None:
        """Store a warning that a sensor's echoes do not match the layout of its settings; empty if they do.

        Call this before the sensor's first energyscape is written.
        """
        self._state(sensor, layout_warning=layout_warning)

    def note_samples(self, sensor: str, samples_warning: str) -> None:
        """Store a warning on dropouts or copies among a sensor's measurements; empty if there are none.

        Call this before the file is closed.
        """
        self._state(sensor, samples_warning=samples_warning)

    def note_wavefront(self, sensor: str, wavefront_error_db: float | None) -> None:
        """Store the error of plane wavefronts at the first range of a sensor; None stores nothing.

        Call this before the sensor's first energyscape is written.
        """
        if wavefront_error_db is not None:
            self._state(sensor, wavefront_error_db=wavefront_error_db)

    def note_truth(self, sensor: str, truth: GroundTruth) -> None:
        """Set the ground truth of a sensor's images, at any time before the file is complete."""
        self._truth[sensor] = truth

    def _state(self, sensor: str, **attributes: float | str) -> None:
        self._stated.setdefault(sensor, {}).update(attributes)

    def _begin(self, group: h5py.Group, first: Energyscape) -> None:
        super()._begin(group, first)
        set_attributes(group, self._stated.get(first.stamp.sensor, {}))
        if self._is_levels:
            self._levels[first.stamp.sensor] = levels = levels_for(first)
            set_attributes(group[self._data], stored_levels(levels))
        if first.level_step_db:
            set_attributes(group, {"level_step_db": first.level_step_db})

    def _row(self, item: Energyscape) -> tuple[NDArray[Any], dict[str, float]]:
        first = self._first[item.stamp.sensor]
        require_uniform(item, first)
        if item.level_step_db != first.level_step_db:
            raise ArgumentError(
                f"level_step_db of an energyscape is {item.level_step_db:g}, but that of the first is "
                f"{first.level_step_db:g}; write it to another file"
            )
        row, columns = super()._row(item)
        if self._is_levels:
            row = encoded(item, self._levels[item.stamp.sensor])
        if item.points is not None:
            self._points.setdefault(item.stamp.sensor, []).append(item.points)
        return row, columns

    def _complete(self, group: h5py.Group, rows: RowWriter) -> None:
        sensor = group.name.rpartition("/")[2]
        clouds = self._points.get(sensor)
        if clouds is not None:
            write_points(group, clouds)
            self._format_version = FORMAT_VERSION
        super()._complete(group, rows)
        set_attributes(group, self._stated.get(sensor, {}))

    def _sensor_truth(self, sensor: str, group: h5py.Group) -> GroundTruth | GroundTruthLog | None:
        given = super()._sensor_truth(sensor, group)
        if given is not None or sensor not in self._recorded:
            return given
        if self._first[sensor].settings.processing.level_directions:
            return None  # The ground truth is in the frame of the sensor.
        truth, recorded = self._recorded[sensor]
        written = RowReader(group, self._data).stamps(sensor)
        if written == recorded:
            return truth
        # Images may be a part of the recording or in another order; each has the truth of its measurement.
        counts = Counter(recorded)
        for index, stamp in enumerate(written):
            if counts[stamp] != 1:
                raise ArgumentError(
                    f"energyscape {index} of sensor {sensor} has the stamp of {counts[stamp]} measurements of the "
                    "recording, but its ground truth needs exactly 1; pass the recording of the images, or truth"
                )
        places = {stamp: index for index, stamp in enumerate(recorded)}
        rows = [places[stamp] for stamp in written]
        return replace(
            truth,
            reflectors=tuple(truth.reflectors[row] for row in rows),
            sources=tuple(truth.sources[row] for row in rows if truth.sources),
            frames=tuple(truth.frames[row] for row in rows if truth.frames),
        )


class EnergyscapeReader(_EnergyscapeFile, ResultReader[Energyscape]):
    """Energyscape file as a sequence of energyscapes, each read when it is indexed.

    The properties ``azimuth_deg`` and ``elevation_deg`` are the angles in degrees.

    Attributes
    ----------
    azimuth_rad, elevation_rad : (direction,) float64
        Directions in the sensor frame, in radians.
    range_m : (range,) float64
        Ranges in metres.
    translation_m : (3,) float64, or None
        Position of the sensor in metres; None if its mounting is unknown.
    rotation_xyzw : (4,) float64, or None
        Unit quaternion that rotates the sensor frame into the platform frame; None if the mounting is unknown.
    trajectory : Trajectory, or None
        Pose of the platform at each image, by increasing time; None if the poses are unknown.
    predicted_error_db, max_error_db : float, or None
        Error that the error model predicted for the first image, and the budget. None in older files and for images of
        the paper's method.
    budget_applies_to : str
        ``echoes`` if images of noise or of many overlapping echoes may exceed the budget of the adaptive beamformer.
        ``beams`` if the budget is that of delay-and-sum beams only, because no plan keeps it for images of the adaptive
        beamformer. Otherwise ``image``. Empty if the file does not contain it.
    error_warning : str
        Warning that images may exceed the budget; empty if they do not, or if no error was predicted.
    wavefront_error_db : float, or None
        Error of plane wavefronts at the first range, relative to spherical ones; None if it is within the budget.
    call_warning : str
        Warning that echoes of the recording do not match the call of its settings, or that the call could not be
        checked; empty if they match, or if the program that wrote the file did not check the call.
    start_warning : str
        Warning that records do not begin with the emission; empty if they may, or if it was not examined.
    layout_warning : str
        Warning that echoes do not match the layout; empty if they may, or if it was not examined.
    level_step_db : float
        Step to which levels were rounded, of images that are or were of type uint8; 0 if they were not.
    samples_warning : str
        Warning that measurements have dropouts or are copies; empty if not, or if it was not examined.
    """

    range_m: NDArray[np.float64]
    predicted_error_db: float | None
    max_error_db: float | None
    budget_applies_to: str
    error_warning: str
    call_warning: str
    start_warning: str
    layout_warning: str
    samples_warning: str
    wavefront_error_db: float | None
    level_step_db: float

    def _select_table(self) -> None:
        self._choose_table(is_levels=LEVELS.name in self._group)

    def _load(self) -> None:
        super()._load()
        stated = self._group.attrs
        self._levels = levels_of(self._group[self._data], self.path) if self._is_levels else None
        step_db = _number(self.path, "level_step_db", stated.get("level_step_db", 0.0))
        if not 0 <= step_db <= MAX_STEP_DB:
            raise DamagedError(f"{self.path}: level_step_db is {step_db:g}; use 0 to {MAX_STEP_DB:g}")
        self.level_step_db = max(step_db, self._levels.step_db if self._levels else 0.0)
        for name in _ERRORS_DB:
            setattr(self, name, _number(self.path, name, stated[name]) if name in stated else None)
        for name in _TEXTS:
            setattr(self, name, str(to_python(stated.get(name, ""))))
        has_points = any(variable.name in self._group for variable in POINTS)
        self._points = PointReader(self._group, self.path, self.settings) if has_points else None

    @property
    def has_points(self) -> bool:
        """True if the images have the points of a fusion."""
        return self._points is not None

    @property
    def points_note(self) -> str | None:
        """Note on fused images without points, whose maxima take their place; None for other images."""
        if self.sensor != PLATFORM_FRAME or self.has_points:
            return None
        return (
            f"{self.path} has fused images without the points of the fusion, so maxima of the images are shown, some "
            "of which may be ghosts; fuse the recordings again with 'ertis fuse'"
        )

    def _values_of(self, row: NDArray[Any]) -> NDArray[np.float32]:
        return super()._values_of(row) if self._levels is None else self._levels.decode(row)

    def _item(self, index: int) -> Energyscape:
        image = replace(super()._item(index), level_step_db=self.level_step_db)
        return image if self._points is None else self._points(image, index)

    def _sizes(self) -> dict[str, int]:
        return super()._sizes() | POINT_SIZES


def _number(path: Path, name: str, value: Any) -> float:
    try:
        found = float(value)
    except (TypeError, ValueError):
        found = math.nan
    if not math.isfinite(found):
        raise DamagedError(f"{path}: attribute {name} is {value!r}, not a finite number; process the recording again")
    return found


def open_energyscapes(path: Source, *, sensor: str | None = None) -> EnergyscapeReader:
    """Open an energyscape file for reading.

    Parameters
    ----------
    path : str, Path or binary file
        As for `open_recording`.
    sensor : str, optional
        Name of the sensor, if the file contains several.

    Raises
    ------
    DataError
        The file is not an energyscape file, is damaged or truncated.
    FormatVersionError
        A newer version wrote the file.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     images = list(ertis.Pipeline(recording.settings).process_many(recording))
    >>> path = ertis.write_energyscapes("images.h5", images, overwrite=True)
    >>> with ertis.open_energyscapes(path) as reader:
    ...     len(reader) == len(images)
    True
    """
    return EnergyscapeReader(path, sensor=sensor)


def write_energyscapes(
    path: str | Path,
    images: Iterable[Energyscape],
    *,
    recording: RecordingReader | Sequence[RecordingReader] | None = None,
    truth: Mapping[str, GroundTruth] | None = None,
    mounting: Mapping[str, Mounting] | None = None,
    dtype: ImageDtype = "float32",
    overwrite: bool = False,
) -> Path:
    """Write an energyscape file.

    Parameters
    ----------
    path : str or Path
    images : iterable of Energyscape
        Images of one or several sensors. It is read one image at a time.
    recording, truth, mounting, dtype, overwrite
        See `EnergyscapeWriter`.

    Returns
    -------
    Path
        The path.

    Raises
    ------
    ArgumentError
        There is no energyscape, settings or axes of a sensor's images differ, or the file exists.
    DataError
        The disk is full or cannot be written.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording, ertis.Pipeline(recording.settings) as pipeline:
    ...     path = ertis.write_energyscapes("images.h5", pipeline.process_many(recording), overwrite=True)
    """
    with EnergyscapeWriter(
        path, recording=recording, truth=truth, mounting=mounting, dtype=dtype, overwrite=overwrite
    ) as writer:
        for image in checks.items("images", images, Energyscape, "Pipeline.process returns"):
            writer.write(image)
    return writer.path
