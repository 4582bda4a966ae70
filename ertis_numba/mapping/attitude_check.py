"""Warning about poses that tilt a platform."""

import warnings
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ertis_numba.errors import PoseWarning
from ertis_numba.frames import Trajectory
from ertis_numba.frames.platform_tilt import tilt_note

__all__ = ["AttitudeCheck"]

_COUNTS: Final = (1, 10, 100)  # Numbers of single poses at which they are examined.
_CALLER: Final = 4  # stack level of the caller of Mapper.add


class AttitudeCheck:
    """Check of the poses of a mapper: each trajectory as a whole, and single poses together."""

    def __init__(self) -> None:
        self._trajectory: Trajectory | None = None
        self._poses: list[NDArray[np.float64]] = []
        self._has_warned = False

    def __call__(self, pose: Any, translation_m: NDArray[np.float64], rotation: NDArray[np.float64]) -> None:
        """Issue a `PoseWarning`, once, if most poses tilt the platform by more than 30°.

        Parameters
        ----------
        pose : Trajectory or a position and a quaternion
        translation_m : (3,) float64
        rotation : (3, 3) float64
            Both are the pose of the pulse.
        """
        if self._has_warned or pose is self._trajectory:
            return
        if isinstance(pose, Trajectory):
            self._trajectory = pose
            self._warn(tilt_note(pose.rotation_xyzw, pose.position_m))
            return
        if len(self._poses) < _COUNTS[-1]:
            self._poses.append(np.concatenate([Rotation.from_matrix(rotation).as_quat(), translation_m]))
            if len(self._poses) in _COUNTS:
                rows = np.array(self._poses)
                self._warn(tilt_note(rows[:, :4], rows[:, 4:]))

    def _warn(self, note: str | None) -> None:
        if note is not None:
            self._has_warned = True
            warnings.warn(note, PoseWarning, stacklevel=_CALLER)
