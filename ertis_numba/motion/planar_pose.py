"""Poses of a platform in the plane, and displacements between them."""

import math
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["Doubt", "PlanarPose", "displacement_of", "relative"]

Floats = NDArray[np.float64]
Doubt: TypeAlias = Literal["", "pause", "few echoes", "other motion", "copies"]


class PlanarPose(NamedTuple):
    """Pose of a platform in the plane, relative to its pose at the first group.

    Attributes
    ----------
    timestamp_ns : int
    x_m, y_m, yaw_rad : float
    covariance : (3, 3) float64
        Covariance of x, y and yaw since the start, in metres and radians.
    doubt : {"", "pause", "few echoes", "other motion", "copies"}
        Reason why the motion is unknown; empty if it was measured. After a pause of more than a second, or if no more
        echoes match than those of noise or of one moving object (``few echoes``), the last velocity is assumed to have
        continued, for at most a second. If another motion explains about as much (``other motion``), the more likely
        one is assumed. Others are standing still, mirrored motion, and the motion of objects. Images that equal those
        before in every value (``copies``) show no motion.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> pose = ertis.PlanarPose(0, 0.0, 0.0, np.pi / 2, np.zeros((3, 3)))
    >>> moved = pose.moved(np.array([1.0, 0.0, 0.0]), np.zeros((3, 3)), 100_000_000)
    >>> round(moved.x_m, 3), round(moved.y_m, 3)
    (0.0, 1.0)
    """

    timestamp_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    covariance: Floats
    doubt: Doubt = ""

    @property
    def is_measured(self) -> bool:
        """False if the motion since the last group is unknown."""
        return not self.doubt

    def moved(self, displacement: Floats, covariance: Floats, timestamp_ns: int, doubt: Doubt = "") -> "PlanarPose":
        """Return the pose after a displacement in the frame of this pose."""
        carried, turned = _propagation(self.yaw_rad, displacement)
        x_m, y_m, turn_rad = (turned @ displacement).tolist()
        return PlanarPose(
            timestamp_ns,
            self.x_m + x_m,
            self.y_m + y_m,
            math.remainder(self.yaw_rad + turn_rad, 2 * math.pi),
            carried @ self.covariance @ carried.T + turned @ covariance @ turned.T,
            doubt,
        )


def relative(origin: PlanarPose, pose: PlanarPose) -> Floats:
    """Return a pose in the frame of another one: (3,) float64."""
    c, s = math.cos(origin.yaw_rad), math.sin(origin.yaw_rad)
    x, y = pose.x_m - origin.x_m, pose.y_m - origin.y_m
    return np.array([c * x + s * y, c * y - s * x, math.remainder(pose.yaw_rad - origin.yaw_rad, 2 * math.pi)])


def displacement_of(twist: Floats, time_s: float) -> Floats:
    """Return the displacement by a constant velocity in the frame of the platform: (3,) float64."""
    x, y, turn = (twist * time_s).tolist()
    shrink = float(np.sinc(turn / 2 / math.pi))
    c, s = math.cos(turn / 2) * shrink, math.sin(turn / 2) * shrink
    return np.array([c * x - s * y, s * x + c * y, turn])


def _propagation(yaw_rad: float, displacement: Floats) -> tuple[Floats, Floats]:
    """Return derivatives of a moved pose by the pose at a yaw, and by the displacement: two (3, 3) float64."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    x_m, y_m, _ = (turned @ displacement).tolist()
    return np.array([[1.0, 0.0, -y_m], [0.0, 1.0, x_m], [0.0, 0.0, 1.0]]), turned
