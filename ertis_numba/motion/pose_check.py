"""Comparison of given poses with the motion that echoes show."""

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ErtisError
from ertis_numba.frames import Trajectory, is_passive
from ertis_numba.fusion.rig import Mountings
from ertis_numba.motion.odometry import Odometry
from ertis_numba.motion.velocity import Item, stamp_of

__all__ = ["PoseCheck"]

Floats = NDArray[np.float64]

_MAX_WAYS: Final = 3
_MAX_PULSES: Final = 32  # Pulses whose motion is computed.
_MIN_STEPS: Final = 4
_LONG_M, _LONG_RAD, _LONG_STEPS = 0.3, math.radians(40.0), 15  # A way ends there.
_SHORT_M, _SHORT_RAD = 0.1, math.radians(10.0)  # Shorter ways decide nothing.
_IDLE_M_S, _IDLE_RAD_S = 0.02, math.radians(2.0)  # Slower poses stand still.
# Standard deviations of good poses: those of positions, headings and mountings, and of times relative to echoes.
_POSE_SD_M, _POSE_SD_RAD, _POSE_SHARE = 0.02, math.radians(5.0), 0.2
_LIMIT_SD: Final = 5.0
_CAUSE_SD: Final = 2.0  # Poses without their fault agree that well.
_UNITS: Final = {
    "centimetres": 1e2,
    "millimetres": 1e3,
    "inches": 1 / 0.0254,
    "feet": 1 / 0.3048,
    "kilometres": 1e-3,
}


class _Way(NamedTuple):
    """Way of a platform by its echoes and by its poses: x, y in m and yaw in rad, in its frame at the start."""

    heard: Floats
    sd: Floats  # of the difference of good poses
    given: Floats
    inverse: Floats  # by the inverse of the poses

    def fits(self, given: Floats, limit_sd: float = _CAUSE_SD) -> bool:
        """Return True if a way agrees with that of the echoes."""
        apart = (given - self.heard) / self.sd
        turn_sd = abs(math.remainder(given[2] - self.heard[2], 2 * math.pi)) / self.sd[2]
        return bool(np.hypot(*apart[:2]) < limit_sd and turn_sd < limit_sd)


class PoseCheck:
    """Check of the poses of pulses by the odometry of some of them."""

    def __init__(self, mountings: Mountings) -> None:
        self._mountings = mountings
        self._odometry: Odometry | None = None
        self._times_ns: list[int] = []
        self._ways: list[_Way] = []
        self._n_pulses = 0
        self._poses: Trajectory | None = None
        self._last_ns: int | None = None

    def add(self, group: Iterable[Item], poses: Trajectory) -> None:
        """Add the images of the next pulse."""
        if self._n_pulses >= _MAX_PULSES or len(self._ways) >= _MAX_WAYS:
            return
        items = [item for item in group if not is_passive(item.settings, item.stamp)]
        if not items:
            return
        if poses is not self._poses:
            self._end()
            self._poses, self._last_ns = poses, None
        time_ns = stamp_of({item.stamp.sensor: item for item in items}).timestamp_ns
        before_ns, self._last_ns = self._last_ns, time_ns
        try:
            if before_ns is not None and _stands(poses, before_ns, time_ns):
                self._end()
                return
            self._n_pulses += 1
            if self._odometry is None:
                self._begin(items, time_ns)
                return
            self._odometry.add(items)
        except ErtisError:  # Echoes that odometry cannot use do not speak against the poses.
            self._odometry = None
            return
        if not self._odometry.poses[-1].is_measured:
            self._end()
            self._begin(items, time_ns)
            return
        self._times_ns.append(time_ns)
        last = self._odometry.poses[-1]
        is_far = math.hypot(last.x_m, last.y_m) > _LONG_M or abs(last.yaw_rad) > _LONG_RAD
        if (is_far and len(self._times_ns) > _MIN_STEPS) or len(self._times_ns) > _LONG_STEPS:
            self._end()

    def warning(self) -> str | None:
        """Return a warning if most ways contradict the poses, with the likely cause."""
        self._end()
        wrong = [way for way in self._ways if not way.fits(way.given, _LIMIT_SD)]
        if len(wrong) <= len(self._ways) / 2:
            return None
        first = wrong[0]
        return (
            f"the echoes show a motion of {_text(first.heard)}, but the poses one of {_text(first.given)}, in "
            f"{len(wrong)} of {len(self._ways)} parts of the path that were compared; {_cause(wrong)}"
        )

    def _begin(self, items: list[Item], time_ns: int) -> None:
        self._odometry, self._times_ns = Odometry(self._mountings), [time_ns]
        self._odometry.add(items)

    def _end(self) -> None:
        """Keep the way of the echoes so far, if it is long enough."""
        found, self._odometry = self._odometry, None
        if found is None or self._poses is None or len(self._times_ns) <= _MIN_STEPS:
            return
        last = found.poses[len(self._times_ns) - 1]
        heard = np.array([last.x_m, last.y_m, last.yaw_rad])
        given, inverse, variance = _ways(self._poses, self._times_ns[0], self._times_ns[-1])
        length = np.array([*(2 * [np.hypot(*heard[:2])]), abs(heard[2])])
        if not any(_is_long(way) for way in (heard, given)):
            return
        good = np.array([_POSE_SD_M, _POSE_SD_M, _POSE_SD_RAD])
        variance = variance + np.diag(last.covariance) + good**2 + (_POSE_SHARE * length) ** 2
        self._ways.append(_Way(heard, np.sqrt(variance), given, inverse))


def _stands(poses: Trajectory, before_ns: int, time_ns: int) -> bool:
    """Return True if the poses stand still between two times."""
    time_s = (time_ns - before_ns) / 1e9
    given, *_ = _ways(poses, before_ns, time_ns)
    return bool(np.hypot(*given[:2]) < _IDLE_M_S * time_s and abs(given[2]) < _IDLE_RAD_S * time_s)


def _is_long(way: Floats) -> bool:
    return bool(np.hypot(*way[:2]) > _SHORT_M or abs(way[2]) > _SHORT_RAD)


def _ways(poses: Trajectory, begin_ns: int, end_ns: int) -> tuple[Floats, Floats, Floats]:
    """Return the way between two times by the poses and by their inverse, and the variance of both poses."""
    both = poses.at([begin_ns, end_ns])
    x, y, z, w = both.rotation_xyzw.T
    yaw = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    place = both.position_m[:, 0] + 1j * both.position_m[:, 1]
    ways = []
    for place_m, yaw_rad in ((place, yaw), (-place * np.exp(-1j * yaw), -yaw)):
        moved = (place_m[1] - place_m[0]) * np.exp(-1j * yaw_rad[0])
        ways.append(np.array([moved.real, moved.imag, math.remainder(yaw_rad[1] - yaw_rad[0], 2 * math.pi)]))
    variance = np.zeros(3)
    if both.covariance is not None:
        of_both = np.trace(both.covariance.sum(axis=0)[:2, :2]), both.covariance[:, 5, 5].sum()
        variance = np.array([of_both[0], of_both[0], of_both[1]])
    return ways[0], ways[1], variance


def _cause(ways: list[_Way]) -> str:
    """Return the likely causes of wrong ways, as a clause with the remedy."""
    found = ["inverted, from world to platform"] if all(way.fits(way.inverse) for way in ways) else []
    for unit, per_m in _UNITS.items():
        if all(way.fits(way.given / (per_m, per_m, 1)) for way in ways):
            found.append(f"in {unit}")
    for text, turn_deg in (("90° too large", 90), ("90° too small", -90), ("180° off", 180)):
        turn = np.exp(1j * math.radians(turn_deg))
        if all(way.fits(_with_place(way.given, turn * _place(way.given))) for way in ways):
            found.append(f"{text} in yaw (or the mounting is, the other way)")
    if all(way.fits(way.given * (1, -1, -1)) for way in ways):
        found.append("mirrored, with y and yaw of the opposite sign")
    if found:
        return f"the poses may be {', or '.join(found)}; correct them"
    return "correct the poses, their times or the mounting, or ignore this if most things around move"


def _place(way: Floats) -> complex:
    return complex(way[0], way[1])


def _with_place(way: Floats, place: complex) -> Floats:
    return np.array([place.real, place.imag, way[2]])


def _text(way: Floats) -> str:
    x_m, y_m, yaw_rad = way.tolist()
    return f"{x_m:+.2f} m ahead, {y_m:+.2f} m to the left and {math.degrees(yaw_rad):+.0f}°"
