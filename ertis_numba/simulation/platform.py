"""Platform that carries the sensors of a scene, and the poses of sensors in the world frame."""

import itertools
import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Trajectory
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import Limits
from ertis_numba.simulation.trajectory import MAX_SPEED_M_S, Coordinate, Instant

__all__ = ["MovingPose", "Platform"]

Floats = NDArray[np.float64]
_MAX_YAW_RATE_DEG_S = 3600.0
_Yaw = Annotated[float, Limits(-360e6, 360e6, "{} yaw_deg")]
_NS_PER_S = 10**9


class MovingPose(NamedTuple):
    """Pose and motion in the world frame at one instant; ``rotation`` (3, 3) is from the object to the world frame."""

    position_m: Floats
    velocity_m_s: Floats
    rotation: Floats
    spin_rad_s: Floats

    def at(self, offset_m: Floats, rotation: Floats) -> "MovingPose":
        """Return the pose of an object at an offset o fixed to this one: ``p' = p + R o`` and ``v' = v + ω × R o``."""
        arm_m = self.rotation @ offset_m
        return MovingPose(
            self.position_m + arm_m,
            self.velocity_m_s + np.cross(self.spin_rad_s, arm_m),
            self.rotation @ rotation,
            self.spin_rad_s,
        )


class Platform(TomlTable, frozen=True, kw_only=True):
    """Platform that moves all sensors of a scene along waypoints.

    Positions and rotations of sensors are relative to the platform: x forward, y left, z up.

    Attributes
    ----------
    waypoints : tuple of (time_s, x, y, z, yaw_deg)
        Times in seconds, positions in the world frame in metres, and rotations to the left in degrees. The platform
        moves on straight lines and turns evenly between them; it rests before the first and after the last. A yaw of
        370° after 350° turns by 20° to the left; one of 10° turns by 340° to the right.

    Examples
    --------
    >>> from ertis_numba.simulation import Platform
    >>> platform = Platform(waypoints=((0.0, 0.0, 0.0, 0.0, 0.0), (2.0, 1.0, 0.0, 0.0, 90.0)))
    >>> pose = platform.pose_at(1.0)
    >>> pose.position_m.tolist(), pose.velocity_m_s.tolist(), pose.spin_rad_s.round(3).tolist()
    ([0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.785])
    """

    waypoints: tuple[tuple[Instant, Coordinate, Coordinate, Coordinate, _Yaw], ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.waypoints:
            raise ArgumentError("platform has no waypoints; write at least one (time_s, x, y, z, yaw_deg)")
        for (before_s, *a, start_deg), (after_s, *b, stop_deg) in itertools.pairwise(self.waypoints):
            if after_s <= before_s:
                raise ArgumentError(
                    f"platform.waypoints go from {before_s:g} s to {after_s:g} s; pass strictly increasing times"
                )
            took_s = after_s - before_s
            checks.between("platform.waypoints speed", math.dist(a, b) / took_s, 0.0, MAX_SPEED_M_S)
            checks.between(
                "platform.waypoints yaw rate",
                (stop_deg - start_deg) / took_s,
                -_MAX_YAW_RATE_DEG_S,
                _MAX_YAW_RATE_DEG_S,
            )

    @property
    def moves(self) -> bool:
        """True if the platform ever moves or turns."""
        return any(before[1:] != after[1:] for before, after in itertools.pairwise(self.waypoints))

    def pose_at(self, time_s: float) -> MovingPose:
        """Return the pose and the motion at a time of the scene."""
        ways = np.array(self.waypoints)
        next_one = int(np.searchsorted(ways[:, 0], time_s, side="right"))
        rates = np.zeros(4)
        place = ways[max(next_one - 1, 0), 1:]
        if 0 < next_one < len(ways):
            start, stop = ways[next_one - 1], ways[next_one]
            rates = (stop[1:] - start[1:]) / (stop[0] - start[0])
            place = start[1:] + (time_s - start[0]) * rates
        yaw_rad = math.radians(place[3])
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        return MovingPose(
            place[:3],
            rates[:3],
            np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]),
            np.array([0.0, 0.0, math.radians(rates[3])]),
        )

    def trajectory(self, time_s: Floats, time_ns: NDArray[np.int64] | None = None) -> Trajectory:
        """Return the poses at times of the scene, with the source "scene" and time stamps ``time_ns`` if given."""
        times_s = np.asarray(time_s, np.float64)
        x, y, z, yaw_deg = (np.interp(times_s, *pair) for pair in self._axes())
        half_rad = np.radians(np.remainder(yaw_deg + 180.0, 360.0) - 180.0) / 2
        none = np.zeros(len(times_s))
        return Trajectory(
            np.rint(times_s * _NS_PER_S).astype(np.int64) if time_ns is None else time_ns,
            np.stack([x, y, z], axis=1),
            np.stack([none, none, np.sin(half_rad), np.cos(half_rad)], axis=1),
            source="scene",
        )

    def _axes(self) -> list[tuple[Floats, Floats]]:
        times_s, *axes = np.array(self.waypoints).T
        return [(times_s, axis) for axis in axes]
