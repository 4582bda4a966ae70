"""Attitudes of a sensor at its measurements, for images in level directions."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.frames import Energyscape, Measurement, Stamp
from ertis_numba.frames.pose_doubts import pose_doubts
from ertis_numba.pipeline import Pipeline
from ertis_numba.storage import RecordingReader

__all__ = ["Attitudes", "unlevelled_image"]

_UNTURNED = (0.0, 0.0, 0.0, 1.0)


class Attitudes:
    """Rotations from a sensor to the world, by default with its recorded mounting, and a note on unlikely poses."""

    def __init__(
        self, recording: RecordingReader, stamps: Sequence[Stamp], rotation_xyzw: Sequence[float] | None = None
    ) -> None:
        from scipy.spatial.transform import Rotation  # noqa: PLC0415  few want them

        name = f"{recording.path}: sensor {recording.sensor}"
        place = recording.rotation_xyzw if rotation_xyzw is None else rotation_xyzw
        if place is None:
            raise DataError(
                f"{name} has no mounting, so its attitude is unknown; add its mounting "
                "(mounting), or process without levelled directions (level_directions)"
            )
        times_ns = np.unique([stamp.timestamp_ns for stamp in stamps])
        n_missing = len(stamps)
        if recording.trajectory is not None:
            n_missing = int(np.count_nonzero(~recording.trajectory.covers([stamp.timestamp_ns for stamp in stamps])))
        if recording.trajectory is None or n_missing:
            raise DataError(
                f"{name} has no pose at {n_missing} of {len(stamps)} measurements; add poses with 'ertis "
                "import poses', or process without levelled directions (level_directions)"
            )
        poses = recording.trajectory.at(times_ns)
        self.note = "; ".join(pose_doubts(poses)) or None
        platform = Rotation.from_quat(poses.rotation_xyzw)
        self._attitudes = dict(zip(times_ns.tolist(), (platform * Rotation.from_quat(place)).as_quat(), strict=True))

    def __call__(self, measurement: Measurement) -> NDArray[np.float64]:
        """Return the unit quaternion x, y, z, w of a measurement."""
        attitude: NDArray[np.float64] = self._attitudes[measurement.stamp.timestamp_ns]
        return attitude


def unlevelled_image(pipeline: Pipeline, measurement: Measurement) -> Energyscape:
    """Return the uncleaned image of a measurement in directions of the sensor frame, for checks of its error."""
    attitude_xyzw = _UNTURNED if pipeline.settings.processing.level_directions else None
    return pipeline.process(measurement, attitude_xyzw=attitude_xyzw, clean=False)
