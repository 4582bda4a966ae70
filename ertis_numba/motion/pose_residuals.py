"""Residuals of the motion that echoes show relative to given poses, with their joint covariance."""

import math
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy.linalg
import scipy.special
from numpy.typing import NDArray

from ertis_numba.frames import Trajectory
from ertis_numba.motion.residuals import twist_of

__all__ = ["N_ERRORS", "Correction", "HeardStep", "PoseResiduals"]

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

N_ERRORS: Final = 6
# Standard deviations of constant errors of good poses, mountings, clocks and odometry: logarithm of the scale, heading,
# logarithm of turns, time, and place of the platform's origin ahead and to the left.
_CONSTANT_SD: Final = np.array([0.03, math.radians(1.5), 0.03, 0.03, 0.02, 0.02])
_STEP_SD: Final = np.array([0.01, 0.01, math.radians(0.5)])  # of single steps of odometry, per second
_POSE_SD: Final = np.array([0.002, math.radians(0.2)])  # least ones of a place and of a heading
_UNKNOWN_SD: Final = np.array([0.01, math.radians(1.0)])  # if too few poses show their scatter
_MIN_POSES: Final = 5
_TRIAL: Final = 1e-2  # of constant errors, for slopes
_FALSE_ALARM: Final = 1e-4  # probability for Gaussian errors
_KNOWN: Final = 0.3  # Least share of the variance of a constant error in that of its estimate.


class HeardStep(NamedTuple):
    """Motion between two pulses by their echoes: velocity ahead and to the left, and yaw rate."""

    before_ns: int
    after_ns: int
    twist: Floats
    covariance: Floats


class Correction(NamedTuple):
    """Correction of poses: a change of places and headings, then the constant errors of `_CONSTANT_SD`."""

    errors: Floats = np.zeros(N_ERRORS)
    change: Callable[[Complex, Floats], tuple[Complex, Floats]] | None = None


_NONE: Final = Correction()


class PoseResiduals:
    """Comparison of measured steps with poses, which may be corrected."""

    def __init__(self, steps: Sequence[HeardStep], poses: Trajectory) -> None:
        origin_ns = steps[0].before_ns
        ends_ns = np.array([(step.before_ns, step.after_ns) for step in steps])
        instant_ns, index = np.unique(ends_ns, return_inverse=True)
        self._ends = index.reshape(ends_ns.shape)
        self._instant_s = (instant_ns - origin_ns) / 1e9
        self._step_s = np.diff(self._instant_s[self._ends], axis=1)
        self.heard = np.array([step.twist for step in steps])
        self._of_steps = scipy.linalg.block_diag(*(step.covariance + np.diag(_STEP_SD**2) for step in steps))
        self._time_s = (poses.time_ns - origin_ns) / 1e9
        x, y, z, w = poses.rotation_xyzw.T
        self._yaw = np.unwrap(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
        self._place = poses.position_m[:, :2] @ [1, 1j]
        self._variance = self._variances(poses)

    def given(self, by: Correction = _NONE) -> Floats:
        """Return the motion of poses during all steps, as of the echoes: (step, 3)."""
        log_scale, heading, log_turn, delay_s, ahead_m, left_m = by.errors
        at_s = self._instant_s + delay_s
        place, yaw = np.interp(at_s, self._time_s, self._place), np.interp(at_s, self._time_s, self._yaw)
        if by.change is not None:
            place, yaw = by.change(place, yaw)
        yaw = yaw[0] + (yaw - yaw[0]) * math.exp(log_turn) + heading
        place = place * math.exp(log_scale) + complex(ahead_m, left_m) * np.exp(1j * yaw)
        before, after = self._ends.T
        moved = (place[after] - place[before]) * np.exp(-1j * yaw[before])
        turn = np.angle(np.exp(1j * (yaw[after] - yaw[before])))
        return twist_of(np.stack([moved.real, moved.imag, turn], axis=1), self._step_s)

    def residual(self, by: Correction = _NONE) -> Floats:
        """Return the motion that echoes show minus that of poses: (3 step,)."""
        found = self.heard - self.given(by)
        full = 2 * math.pi / self._step_s[:, 0]
        found[:, 2] -= full * np.round(found[:, 2] / full)
        return found.ravel()

    def slopes(self, by: Correction) -> Floats:
        """Return the derivatives of the motion of poses by constant errors: (3 step, 6)."""
        trials = _TRIAL * np.eye(N_ERRORS)
        pairs = [[self.given(by._replace(errors=by.errors + sign * trial)) for sign in (1, -1)] for trial in trials]
        return np.stack([(more - less).ravel() / (2 * _TRIAL) for more, less in pairs], axis=1)

    def covariance(self, by: Correction, slopes: Floats | None = None) -> Floats:
        """Return the joint covariance of all residuals, with constant errors if their slopes are given."""
        given, number, time_s = self.given(by), np.arange(len(self.heard)), self._step_s[:, 0]
        by_pose = np.zeros((len(given), 3, len(self._instant_s), 3))
        turn = np.exp(-1j * np.interp(self._instant_s, self._time_s, self._yaw)[self._ends].mean(axis=1))
        for instant, sign in zip(self._ends.T, (-1, 1), strict=True):
            by_pose[number, 0, instant, 0] = by_pose[number, 1, instant, 1] = sign * turn.real / time_s
            by_pose[number, 1, instant, 0] = sign * turn.imag / time_s
            by_pose[number, 0, instant, 1] = -sign * turn.imag / time_s
            by_pose[number, 0, instant, 2], by_pose[number, 1, instant, 2] = given[:, 1] / 2, -given[:, 0] / 2
            by_pose[number, 2, instant, 2] = sign / time_s
        flat = by_pose.reshape(given.size, -1)
        found = self._of_steps + flat * self._variance[:, [0, 0, 1]].ravel() @ flat.T
        return np.asarray(found if slopes is None else found + slopes * _CONSTANT_SD**2 @ slopes.T)

    def contradicts(self, by: Correction = _NONE) -> bool:
        """Return True if echoes contradict poses, even without the step that does so most."""
        slopes = self.slopes(by)
        return self._exceeds(self.residual(by), self.covariance(by, slopes), slopes)

    def shows_motion(self) -> bool:
        """Return True if echoes differ from a platform at rest by more than the errors of echoes and poses."""
        return self._exceeds(self.heard.ravel(), self.covariance(_NONE))

    def square(self, by: Correction) -> float:
        """Return the normalised square of all residuals."""
        residual = self.residual(by)
        return float(residual @ np.linalg.solve(self.covariance(by, self.slopes(by)), residual))

    def fitted(self, by: Correction, numbers: Sequence[int], rounds: int = 8) -> Correction:
        """Return a correction with some constant errors, by number, of the least squares."""
        for _ in range(rounds):
            residual, slopes = self.residual(by), self.slopes(by)[:, list(numbers)]
            weighted = np.linalg.solve(self.covariance(by), slopes)
            normal = slopes.T @ weighted + 1e-9 * np.eye(len(numbers))
            errors = by.errors.copy()
            errors[list(numbers)] += np.linalg.solve(normal, weighted.T @ residual).clip(-0.5, 0.5)
            by = by._replace(errors=errors)
        return by

    def worst(self) -> int:
        """Return the number of the step whose poses contradict its echoes most."""
        return int(np.argmax(_of_each(self.residual(), self.covariance(_NONE, self.slopes(_NONE)))))

    def _exceeds(self, residual: Floats, covariance: Floats, slopes: Floats | None = None) -> bool:
        """Return True if residuals, or one of their constant errors, are larger than by accident."""
        kept = np.arange(len(residual)) // 3 != np.argmax(_of_each(residual, covariance))
        residual, covariance = residual[kept], covariance[np.ix_(kept, kept)]
        weighted = np.linalg.solve(covariance, residual)
        if residual @ weighted > scipy.special.chdtri(len(residual), _FALSE_ALARM):
            return True
        if slopes is None:
            return False
        slopes = slopes[kept]
        inverse_variance = np.einsum("rk,rk->k", slopes, np.linalg.solve(covariance, slopes))
        # Noise of poses at rest resembles any constant error, but determines none.
        is_known = inverse_variance * _CONSTANT_SD**2 > _KNOWN
        score = (slopes.T @ weighted)[is_known] ** 2 / inverse_variance[is_known]
        return bool(np.any(score > scipy.special.chdtri(1, _FALSE_ALARM / N_ERRORS)))

    def _variances(self, poses: Trajectory) -> Floats:
        """Return the variances of places, along an axis, and of headings at all instants: (instant, 2)."""
        time_s, at_s = self._time_s, self._instant_s
        columns = np.stack([self._place, self._yaw.astype(complex)], axis=1)
        bends = np.zeros((max(0, len(time_s) - 2), 2), complex)  # distance of poses from the line of their neighbours
        if len(bends):
            share = ((time_s[1:-1] - time_s[:-2]) / (time_s[2:] - time_s[:-2]))[:, None]
            bends = columns[1:-1] - columns[:-2] * (1 - share) - columns[2:] * share
        first, last = np.searchsorted(time_s, at_s[[0, -1]])
        near = bends[max(0, first - 3) : last + 3]
        if poses.covariance is not None:
            stated = np.trace(poses.covariance[:, :2, :2], axis1=1, axis2=2) / 2, poses.covariance[:, 5, 5]
            noise = np.stack([np.interp(at_s, time_s, column) for column in stated], axis=1)
        elif len(near) < _MIN_POSES:
            noise = _UNKNOWN_SD**2
        else:  # Differences of distances have 5 times the variance of poses, and 10 times in two dimensions.
            noise = np.mean(np.abs(np.diff(near, axis=0)) ** 2, axis=0) / [10, 5]
        if not len(bends):
            return np.asarray(noise + _POSE_SD**2 + np.zeros((len(at_s), 2)))
        before = np.searchsorted(time_s, at_s, side="right").clip(1, len(time_s) - 1) - 1
        share = ((at_s - time_s[before]) / (time_s[before + 1] - time_s[before])).clip(0, 1)[:, None]
        # In the middle of two poses, the line between them is a quarter as far from the path as poses are from theirs.
        curve = np.abs(bends)[[(before - 1).clip(0, len(bends) - 1), before.clip(0, len(bends) - 1)]].max(axis=0)
        return np.asarray(noise + (curve * share * (1 - share)) ** 2 + _POSE_SD**2)


def _of_each(residual: Floats, covariance: Floats) -> Floats:
    """Return the normalised square of each step: (step,)."""
    count = len(residual) // 3
    blocks = covariance.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count)]
    each = residual.reshape(count, 3, 1)
    return np.asarray((each * np.linalg.solve(blocks, each)).sum(axis=(1, 2)))
