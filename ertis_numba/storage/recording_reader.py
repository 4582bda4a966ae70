"""Reader of recordings."""

import itertools
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError, DamagedError, DataError
from ertis_numba.base.notebook_html import shown_in_notebooks
from ertis_numba.frames import Measurement, SequenceGap, Trajectory
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import microphones
from ertis_numba.settings import Air
from ertis_numba.storage._mounting import read_mounting
from ertis_numba.storage._poses import (
    POSE_SIZES,
    read_poses,
)
from ertis_numba.storage._reader import FileReader
from ertis_numba.storage.recording_variables import AIR, axis_sizes, data_and_table, layout_arrays
from ertis_numba.storage.schema import POSES
from ertis_numba.storage.variables import to_python

__all__ = ["RecordingReader", "open_recording"]


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
        columns = (self._group[f"gap_{name}"][:].tolist() for name in ("first", "last", "reason"))
        session_ids = (
            self._group["gap_session_id"][:].tolist() if "gap_session_id" in self._group else itertools.repeat(0)
        )
        try:
            self.gaps = tuple(
                SequenceGap(self.sensor, first, last, reason.decode(), session_id)
                for (first, last, reason), session_id in zip(zip(*columns, strict=True), session_ids, strict=False)
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


def open_recording(path: str | Path, *, sensor: str | None = None) -> RecordingReader:
    """Open a recording for reading.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    sensor : str, optional
        Name of the sensor; required if the file contains several.

    Returns
    -------
    RecordingReader

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
