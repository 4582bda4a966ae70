"""Poses, odometry and surroundings of a drive, which accompany its echoes in a data set."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Trajectory

if TYPE_CHECKING:
    from ertis_numba.simulation import Scene

__all__ = ["Drive"]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Drive:
    """Poses of a platform for a data set of BatSLAM 2.0.

    Attributes
    ----------
    poses : Trajectory
        True poses of the platform in the world frame, which cover all measurements.
    odometry : Trajectory
        Poses by odometry, in a frame of their own, which cover all measurements.
    scene : Scene, optional
        Scene in the world frame, whose resting reflectors the data set contains; none by default.
    beam_azimuth_deg : float, default 30.0
        Azimuth of the left virtual ear in degrees; that of the right one is its negative. BatSLAM 2.0 uses 30°.

    Raises
    ------
    ArgumentError
        Poses or odometry are not a trajectory, or the azimuth is not from -90 to 90.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> path = ertis.Trajectory([0, 10**9], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0, 1]] * 2)
    >>> ertis.Drive(poses=path, odometry=path).beam_azimuth_deg
    30.0
    """

    poses: Trajectory
    odometry: Trajectory
    scene: "Scene | None" = None
    beam_azimuth_deg: float = 30.0

    def __post_init__(self) -> None:
        for name in ("poses", "odometry"):
            given = getattr(self, name)
            if not isinstance(given, Trajectory):
                raise ArgumentError(f"{name} is of type {type(given).__name__}; pass a Trajectory of the platform")
        checks.between("beam_azimuth_deg", self.beam_azimuth_deg, -90.0, 90.0)
