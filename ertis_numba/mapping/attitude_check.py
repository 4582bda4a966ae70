"""Warning about poses that are hardly those of a platform."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ertis_numba.frames import Trajectory
from ertis_numba.frames.pose_doubts import PoseWatch, warn_of_poses

__all__ = ["AttitudeCheck"]

_CALLER: Final = 3  # stack level of the caller of Mapper.add


class AttitudeCheck:
    """Check of the poses of a mapper: each trajectory as a whole, and single poses together."""

    def __init__(self) -> None:
        self._trajectory: Trajectory | None = None
        self._watch = PoseWatch()

    def __call__(self, pose: Any, translation_m: NDArray[np.float64], rotation: NDArray[np.float64]) -> None:
        """Issue a `PoseWarning` for a doubtful pose of a pulse, once for each trajectory."""
        if not isinstance(pose, Trajectory):
            self._watch(translation_m, Rotation.from_matrix(rotation).as_quat(), stacklevel=_CALLER)
        elif pose is not self._trajectory:
            self._trajectory = pose
            warn_of_poses(pose, stacklevel=_CALLER)
