"""Comparison of given poses with the motion that echoes show."""

import math
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ErtisError
from ertis_numba.frames import Trajectory, is_passive
from ertis_numba.fusion.rig import Mountings
from ertis_numba.motion.odometry import Odometry
from ertis_numba.motion.pose_residuals import N_ERRORS, Correction, HeardStep, PoseResiduals
from ertis_numba.motion.velocity import Item, stamp_of

__all__ = ["PoseCheck"]

_MAX_PULSES: Final = 32  # Pulses in a row whose motion is computed.
_BURST: Final = 5  # Later, only as many after 64, 128, 256, … pulses.
_MIN_STEPS: Final = 4
_MIN_SHARE: Final = 1 / 3  # of measured steps; if most are uncertain, the others may be wrong.
_IDLE_M_S, _IDLE_RAD_S = 0.02, math.radians(2.0)  # Slower poses stand still.
_FIRST_IDLE: Final = 8  # Poses that stand still are compared after as many pulses, in case they are frozen.
_EQUAL: Final = 6.0  # Difference of normalised squares at which causes are about as likely.
_NEAR: Final = 0.3  # Difference of the factors of a fit and of the mean speeds
_SAME: Final = 0.1  # Difference of factors that units explain
_LATE_S: Final = np.arange(-20, 21) / 10
_MAX_LEVER_M: Final = 1.0  # Distance of a tracked point from the platform's origin
_TINY: Final = 1e-9
_NONE: Final = Correction()
_UNITS: Final = {
    "centimetres": 1e2,
    "millimetres": 1e3,
    "inches": 1 / 0.0254,
    "feet": 1 / 0.3048,
    "kilometres": 1e-3,
}
_CHANGES: Final = {
    "inverted, from world to platform": lambda place, yaw: (-place * np.exp(-1j * yaw), -yaw),
    "mirrored, with y and yaw of the opposite sign": lambda place, yaw: (np.conj(place), -yaw),
    "mirrored, with x and y swapped": lambda place, yaw: (1j * np.conj(place), yaw),
    "turned the wrong way, with yaw of the opposite sign": lambda place, yaw: (place, -yaw),
}


class PoseCheck:
    """Check of the poses of pulses by the odometry of some of them."""

    def __init__(self, mountings: Mountings) -> None:
        self._mountings = mountings
        self._poses: Trajectory | None = None
        self._last_ns: int | None = None
        self._odometry: Odometry | None = None
        self._steps: list[HeardStep] = []
        self._n_tried, self._n_moving, self._n_idle = 0, 0, 0
        self._n_unused = 0  # trajectories that gave no step
        self._contradiction: str | None = None

    def add(self, group: Iterable[Item], poses: Trajectory) -> None:
        """Add the images of the next pulse."""
        items = [item for item in group if not is_passive(item.settings, item.stamp)]
        if not items:
            return
        if poses is not self._poses:
            self._contradiction = self.warning()
            self._begin(poses)
        time_ns = stamp_of({item.stamp.sensor: item for item in items}).timestamp_ns
        before_ns, self._last_ns = self._last_ns, time_ns
        try:
            if before_ns is not None and not self._is_chosen(poses, before_ns, time_ns):
                self._odometry = None
                return
            if self._odometry is None:
                self._odometry = Odometry(self._mountings)
                self._odometry.add(items)
                return
            found = self._odometry.add(items)
        except ErtisError:  # Echoes that odometry cannot use do not speak against the poses.
            self._odometry = None
            return
        self._n_tried += 1
        if found is not None and before_ns is not None:
            twist = np.array([*found.velocity_m_s, found.yaw_rate_rad_s])
            self._steps.append(HeardStep(before_ns, time_ns, twist, found.covariance))

    def warning(self) -> str | None:
        """Return a warning if the echoes contradict the poses, with the likely cause."""
        if self._contradiction or self._poses is None or len(self._steps) < self._n_needed:
            return self._contradiction
        compared = PoseResiduals(self._steps, self._poses)
        if not compared.contradicts():
            return None
        worst = compared.worst()
        time_s = self._steps[worst].before_ns / 1e9
        return (
            f"the echoes contradict the poses: at {time_s:.3f} s, they show {_text(compared.heard[worst])}, but the "
            f"poses {_text(compared.given()[worst])} ({len(self._steps)} steps compared); {_cause(compared)}"
        )

    def note(self) -> str | None:
        """Return the reason why moving poses could not be compared with the echoes, if so."""
        if self._n_unused >= _MIN_STEPS and not (self._steps or self.warning()):
            reason = "nearly every pulse has a trajectory of its own; pass one that covers all pulses"
            return f"the poses were not compared with the echoes: {reason}"
        if not self._n_moving or self.warning():
            return None
        if len(self._steps) < self._n_needed:
            reason = (
                f"they show the motion in {len(self._steps)} of {self._n_tried} steps, and {self._n_needed} are needed"
            )
        elif self._poses is None or PoseResiduals(self._steps, self._poses).shows_motion():
            return None
        else:
            reason = "the motion is smaller than the errors of echoes and poses"
        return f"the poses were not compared with the echoes: {reason}"

    @property
    def _n_needed(self) -> int:
        """Measured steps that a comparison needs."""
        return max(_MIN_STEPS, math.ceil(_MIN_SHARE * self._n_tried))

    def _begin(self, poses: Trajectory) -> None:
        """Forget the steps of other poses."""
        self._n_unused += self._poses is not None and not self._steps
        self._poses, self._last_ns, self._odometry, self._steps = poses, None, None, []
        self._n_tried, self._n_moving, self._n_idle = 0, 0, 0

    def _is_chosen(self, poses: Trajectory, before_ns: int, time_ns: int) -> bool:
        """Return True for most of the first pulses while the poses move, and for few others."""
        ends, time_s = poses.at([before_ns, time_ns]), (time_ns - before_ns) / 1e9
        way_m = np.linalg.norm(np.diff(ends.position_m, axis=0))
        turn_rad = 2 * math.acos(min(1.0, abs(float(ends.rotation_xyzw[0] @ ends.rotation_xyzw[1]))))
        if way_m < _IDLE_M_S * time_s and turn_rad < _IDLE_RAD_S * time_s:
            self._n_idle += 1
            return self._n_idle >= _FIRST_IDLE and _begins(self._n_idle)
        self._n_moving += 1
        return self._n_moving < _MAX_PULSES or _begins(self._n_moving)


def _begins(number: int) -> bool:
    """Return True for the first numbers after each power of two."""
    return number - (1 << (number.bit_length() - 1)) < _BURST


def _cause(compared: PoseResiduals) -> str:
    """Return the likely causes of a contradiction, as a clause with the remedy."""
    tried = [(Correction(change=change), text) for text, change in _CHANGES.items()] + list(_constant(compared))
    found = [(compared.square(by), text) for by, text in tried if not compared.contradicts(by)]
    given = compared.given()
    if not found and np.all(np.abs(given[:, 2]) < _IDLE_RAD_S) and np.ptp(given[:, 0] + 1j * given[:, 1]):
        found = [(0.0, "without the turns of the platform")]
    if not found:
        return "correct the poses, their times or the mounting, or ignore this if most things around move"
    least = min(square for square, _ in found)
    texts = [text for square, text in sorted(found) if square < least + _EQUAL]
    return f"the poses may be {', or '.join(texts)}; correct them"


def _constant(compared: PoseResiduals) -> Iterator[tuple[Correction, str]]:
    """Yield corrections of constant errors, and their descriptions."""
    heard, given = ((each[:, 0] + 1j * each[:, 1], each[:, 2]) for each in (compared.heard, compared.given()))

    def fitted(number: int, start: float) -> tuple[Correction, float]:
        by = compared.fitted(Correction(start * np.eye(N_ERRORS)[number]), [number])
        return by, float(by.errors[number])

    slower = (np.abs(heard[0]).sum() + _TINY) / (np.abs(given[0]).sum() + _TINY)
    by, log_scale = fitted(0, math.log(slower))
    factor = math.exp(-log_scale)
    units = [unit for unit, per_m in _UNITS.items() if abs(factor / per_m - 1) < _SAME]
    if abs(factor * slower - 1) < _NEAR:  # No scale turns other motions into rest.
        yield by, f"in {units[0]}" if units else f"too large by a factor of {factor:.2g}"
    by, turn = fitted(1, float(np.angle(np.vdot(heard[0], given[0]))))
    turn_deg = math.degrees(math.remainder(turn, 2 * math.pi))
    way = f"{abs(turn_deg):.0f}° too {'small' if turn_deg > 0 else 'large'}" if abs(turn_deg) < 170 else "180° off"
    yield by, f"{way} in yaw (or the mounting is, the other way)"
    ratio = float(given[1] @ heard[1]) / (float(given[1] @ given[1]) + _TINY)
    if ratio > 0:
        by, log_turn = fitted(2, math.log(ratio))
        yield by, f"turned too far by a factor of {math.exp(-log_turn):.2g}"
    trials = [Correction(late_s * np.eye(N_ERRORS)[3]) for late_s in _LATE_S]
    by, late_s = fitted(3, float(min(trials, key=compared.square).errors[3]))
    yield by, f"{abs(late_s):.2f} s {'late' if late_s > 0 else 'early'}"
    by = compared.fitted(_NONE, [4, 5])
    ahead_m, left_m = (-by.errors[4:]).tolist()
    if math.hypot(ahead_m, left_m) < _MAX_LEVER_M:
        yield by, f"those of a point {ahead_m:+.2f} m ahead and {left_m:+.2f} m to the left of the platform's origin"


def _text(twist: NDArray[np.float64]) -> str:
    ahead_m_s, left_m_s, yaw_rad_s = twist.tolist()
    return f"{ahead_m_s:+.2f} m/s ahead, {left_m_s:+.2f} m/s to the left and {math.degrees(yaw_rad_s):+.0f}°/s"
