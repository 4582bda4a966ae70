"""Poses that are hardly those of a platform: on its side, mirrored, in other units, or in ECEF."""

import warnings
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import PoseWarning
from ertis_numba.frames._trajectory import Trajectory
from ertis_numba.frames.platform_tilt import tilt_note

__all__ = ["PoseWatch", "pose_doubts", "warn_of_poses"]

Floats = NDArray[np.float64]

_COUNTS: Final = (1, 10, 100)  # Numbers of single poses at which they are examined.
_EARTH_M: Final = (6.33e6, 6.42e6)  # Distances of places on the ground from the centre of the Earth.
_HEIGHT_M: Final = 1e4  # No height reaches it, but a third coordinate from the centre of the Earth does.
_FAST_M_S: Final = 60.0
_LEAP_M: Final = 1.0  # Shorter steps may be noise of poses that follow each other closely.
_N_PLACES: Final = 2000  # Poses that are examined.
_KNOT: Final = 0.025  # Distance between places where the course is measured, relative to the extent of the path.
_KNOT_M: Final = 0.05
_N_COURSES: Final = 6
_SPAN: Final = float(np.radians(45.0))
_FAR: Final = float(np.radians(20.0))  # The heading follows the course neither forwards, backwards nor sideways.
_NEAR: Final = float(np.radians(10.0))


def pose_doubts(poses: Trajectory) -> tuple[str, ...]:
    """Return notes on poses that are hardly those of a platform."""
    place_m = poses.position_m
    found = (
        _earth_note(place_m),
        tilt_note(poses.rotation_xyzw, place_m) or _course_note(place_m, poses.rotation_xyzw),
        _speed_note(poses.time_ns, place_m),
    )
    return tuple(filter(None, found))


def warn_of_poses(poses: Trajectory, *, stacklevel: int) -> None:
    """Issue a `PoseWarning` for each doubt that the notes of a file have not stated."""
    for note in pose_doubts(poses):
        if note not in poses.notes:
            warnings.warn(note, PoseWarning, stacklevel=stacklevel + 1)


class PoseWatch:
    """Check of poses that arrive one by one, which warns once if most of them tilt the platform."""

    def __init__(self) -> None:
        self._poses: list[tuple[Floats, Floats]] = []
        self._has_warned = False

    def __call__(self, position_m: Floats, rotation_xyzw: Floats, *, stacklevel: int) -> None:
        """Examine the poses so far, at some numbers of them."""
        if self._has_warned or len(self._poses) == _COUNTS[-1]:
            return
        self._poses.append((position_m, rotation_xyzw))
        if len(self._poses) not in _COUNTS:
            return
        note = tilt_note(*(np.array(each) for each in reversed(tuple(zip(*self._poses, strict=True)))))
        if note is not None:
            self._has_warned = True
            warnings.warn(note, PoseWarning, stacklevel=stacklevel + 1)


def _earth_note(place_m: Floats) -> str | None:
    """Return a note if positions are relative to the centre of the Earth (ECEF), where z is not up."""
    away_m = np.linalg.norm(place_m, axis=1)
    is_earth = (_EARTH_M[0] < away_m) & (away_m < _EARTH_M[1]) & (np.abs(place_m[:, 2]) > _HEIGHT_M)
    if not is_earth.all():
        return None
    return (
        f"positions are {np.median(away_m) / 1e3:.0f} km from the origin, as those relative to the centre of the Earth "
        "(ECEF), whose z axis is not up; convert positions and rotations to a local frame (east, north, up)"
    )


def _speed_note(time_ns: NDArray[np.int64], place_m: Floats) -> str | None:
    """Return a note if the platform moves faster than any robot."""
    steps_m = np.linalg.norm(np.diff(place_m, axis=0), axis=1)
    speeds_m_s = steps_m / (np.diff(time_ns) / 1e9)
    fast = np.flatnonzero((speeds_m_s > _FAST_M_S) & (steps_m > _LEAP_M))
    if not fast.size:
        return None
    worst = int(fast[np.argmax(speeds_m_s[fast])])
    return (
        f"the platform moves at up to {speeds_m_s[worst]:.3g} m/s, from pose {worst + 1} to pose {worst + 2} of "
        f"{len(place_m)} ({steps_m[worst]:.3g} m); positions are in metres, so correct their unit or that of the "
        "times, or leave out poses before or after a jump"
    )


def _course_note(place_m: Floats, rotation_xyzw: Floats) -> str | None:
    """Return a note if the heading turns against the course, or 57 times less: mirrored axes, or radians as degrees."""
    course, heading = _courses(place_m, rotation_xyzw)
    if len(course) < _N_COURSES or np.ptp(np.unwrap(course)) < _SPAN or _misfit(course - heading) < _FAR:
        return None
    if _misfit(course + heading) < _NEAR:
        return (
            "the heading turns right where the path turns left, as in a left-handed world, or with angles that count "
            "clockwise; poses have x forward, y left and z up, and yaw counts anticlockwise as seen from above, so "
            "correct the signs of y or of yaw, or ignore this if the platform really moves so"
        )
    if _misfit(course - np.degrees(heading)) < _NEAR:
        return (
            "the heading turns by 1/57 of what the path turns, as if radians were read as degrees; if so, name the "
            "column yaw_rad, or ignore this if the platform really moves so"
        )
    return None


def _courses(place_m: Floats, rotation_xyzw: Floats) -> tuple[Floats, Floats]:
    """Return the directions of the path between places some distance apart, and the headings there, in radians."""
    chosen = np.unique(np.linspace(0, len(place_m) - 1, min(len(place_m), _N_PLACES)).astype(int))
    ground_m, (x, y, z, w) = place_m[chosen, :2], rotation_xyzw[chosen].T
    apart_m = max(_KNOT_M, _KNOT * float(np.hypot(*np.ptp(ground_m, axis=0))))
    knots = [0]
    for number in range(1, len(ground_m)):
        if np.hypot(*(ground_m[number] - ground_m[knots[-1]])) >= apart_m:
            knots.append(number)
    steps_m = np.diff(ground_m[knots], axis=0)
    turns = np.exp(1j * np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))[knots]
    return np.arctan2(steps_m[:, 1], steps_m[:, 0]), np.angle(turns[1:] + turns[:-1])


def _misfit(angles: Floats) -> float:
    """Return the circular standard deviation of angles, in radians."""
    length = float(np.abs(np.mean(np.exp(1j * angles))))
    return float(np.sqrt(-2 * np.log(max(length, 1e-300))))
