"""Robust fit of the motion of a platform to the flow of echoes."""

import math
from typing import Final, NamedTuple

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ertis_numba.fusion.rig import MountedSensor
from ertis_numba.motion.echoes import GroupEchoes

__all__ = ["FlowFit", "fit_flow", "twist_of"]

Floats = NDArray[np.float64]

MAX_SPEED_M_S: Final = 2.0
MAX_YAW_RATE_RAD_S: Final = math.radians(120.0)
_SEARCH_STEP: Final = np.array([0.0125, 0.0125, math.radians(1.25)])  # of x, y and yaw, below _SEARCH_SD
_MAX_STEPS: Final = 17  # per axis; larger reaches have larger steps.
_SEARCH_SD: Final = 0.02, math.radians(2.0)
_SCALES: Final = 8.0, 5.0, 3.0, 2.0, 1.4, 1.0
_N_STARTS: Final = 4
_ELSEWHERE: Final = np.array([0.02, 0.02, math.radians(2.0)])  # Differences of displacements that are not the same.
# In simulated rooms, correct displacements had ambiguities of at most 0.65. Wrong ones, by the spacing of equal posts,
# had at least 0.75, as one post of four without a partner.
_MAX_AMBIGUITY: Final = 0.7
# Share of the echoes that a rival must explain otherwise. Other echoes, such as those of calls from behind, may move in
# their own way, which makes nothing ambiguous; the stronger motion wins.
_SHARED: Final = 0.2
# Expected number of motions by which unrelated groups match as well; an upper limit of the rate of false alarms.
_MAX_FALSE_ALARMS: Final = 1e-3
_STRONGEST: Final = 40  # Number of echoes per sensor that the search uses.
_ROUNDS: Final = 8
_MAX_LEVEL_CHANGE: Final = math.log(4.0)  # of amplitudes, 12 dB
_OUTLIER: Final = math.exp(-0.5 * 9.0)  # Likelihood of an echo without a partner: three standard deviations.
_GATE: Final = 9.0
_STEP: Final = 1e-6
_TRIALS: Final = _STEP * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
# Errors of neighbouring echoes are correlated, so residuals underestimate those of the motion by these factors. They
# were measured in simulated rooms other than those of `ertis bench motion`.
_INFLATION: Final = np.diag([1.25, 1.25, 1.6])


class FlowFit(NamedTuple):
    """Displacement of a platform between two groups of echoes.

    Attributes
    ----------
    displacement : (3,) float64
        x and y in metres and yaw in radians, in the frame of the platform at the first group.
    covariance : (3, 3) float64
    n_matches : int
        Number of echoes that the displacement explains.
    share : float
        Share of echoes that the displacement explains.
    score : float
        Number of matches, weighted by the strengths of their echoes; the larger one of two fits to the same groups is
        more likely.
    ambiguity : float
        Score of the best displacement elsewhere that explains some of the same echoes, relative to this one.
    n_false_alarms : float
        Expected number of displacements that explain as many echoes of unrelated groups, by accident.
    """

    displacement: Floats
    covariance: Floats
    n_matches: int
    share: float
    score: float
    ambiguity: float = 0.0
    n_false_alarms: float = 0.0

    @property
    def is_significant(self) -> bool:
        """True if unrelated groups do not match as well by accident."""
        return self.n_false_alarms < _MAX_FALSE_ALARMS

    @property
    def is_certain(self) -> bool:
        """True if no other displacement explains the echoes almost as well."""
        return self.ambiguity < _MAX_AMBIGUITY


class _EchoPairs(NamedTuple):
    """Echoes of both groups that may come from the same reflector."""

    before: NDArray[np.int64]
    after: NDArray[np.int64]


def twist_of(displacement: Floats, time_s: float) -> Floats:
    """Return the constant twists, forward, left and yaw per second, that produce displacements.

    Parameters
    ----------
    displacement : (..., 3) float64
        x, y and yaw.
    time_s : float

    Returns
    -------
    (..., 3) float64
        x, y and yaw per second.
    """
    x, y, yaw = np.moveaxis(displacement, -1, 0)
    half = yaw / 2
    # Inverse of the chord of an arc, turned back by half of the angle.
    grow = 1 / np.sinc(half / math.pi)
    c, s = np.cos(half) * grow, np.sin(half) * grow
    return np.stack([c * x + s * y, c * y - s * x, yaw], axis=-1) / time_s


def _predicted(
    displacement: Floats, before: GroupEchoes, offset_m: Floats, first: Floats, second: Floats
) -> tuple[Floats, Floats]:
    """Return range and azimuth of echoes after trial displacements: two (trial, echo) float64.

    Echoes are placed where they were at the first emission, and then where they appear after the second one, as
    `compensate_motion` describes.

    Parameters
    ----------
    displacement : (trial, 3) float64
    before : GroupEchoes
    offset_m : (echo, axis) float64
        Positions of the sensors on the platform.
    first, second : (trial, 3) or (1, 3) float64
        Twists at both groups.
    """
    from_sensor_m = before.position_m - offset_m
    x_m, y_m = _turned(from_sensor_m[:, 0], from_sensor_m[:, 1], first[:, 2:] * before.arrival_s)
    way_x_m, way_y_m = _way_m(x_m, y_m, first, offset_m, before.range_m, before.delay_s, before.arrival_s)
    x_m, y_m = x_m + way_x_m + offset_m[:, 0], y_m + way_y_m + offset_m[:, 1]
    x_m, y_m = _turned(x_m - displacement[:, :1], y_m - displacement[:, 1:2], -displacement[:, 2:])
    x_m, y_m = x_m - offset_m[:, 0], y_m - offset_m[:, 1]
    square_z_m2 = from_sensor_m[:, 2] ** 2
    range_m = np.sqrt(x_m**2 + y_m**2 + square_z_m2)
    later_s = (range_m - before.range_m) / before.sound_speed_m_s
    delay_s, arrival_s = before.delay_s + later_s, before.arrival_s + 2 * later_s
    way_x_m, way_y_m = _way_m(x_m, y_m, second, offset_m, range_m, delay_s, arrival_s)
    x_m, y_m = x_m - way_x_m, y_m - way_y_m
    return np.sqrt(x_m**2 + y_m**2 + square_z_m2), np.arctan2(y_m, x_m) - second[:, 2:] * arrival_s


def _way_m(
    x_m: Floats, y_m: Floats, twist: Floats, offset_m: Floats, range_m: Floats, delay_s: Floats, arrival_s: Floats
) -> tuple[Floats, Floats]:
    """Return the way of the sensors until the range and the direction of each echo apply: two (trial, echo) float64."""
    x_m_s, y_m_s = twist[:, :1] - twist[:, 2:] * offset_m[:, 1], twist[:, 1:2] + twist[:, 2:] * offset_m[:, 0]
    along = (x_m * x_m_s + y_m * y_m_s) / range_m**2 * (delay_s - arrival_s)
    return arrival_s * x_m_s + along * x_m, arrival_s * y_m_s + along * y_m


def _turned(x_m: Floats, y_m: Floats, angle_rad: Floats) -> tuple[Floats, Floats]:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return c * x_m - s * y_m, s * x_m + c * y_m


class _Flow:
    """Residuals of pairs of echoes, in standard deviations."""

    def __init__(
        self,
        before: GroupEchoes,
        after: GroupEchoes,
        sensors: tuple[MountedSensor, ...],
        time_s: float,
        twists: tuple[Floats | None, Floats | None],
    ) -> None:
        self.before, self.after, self._time_s = before, after, time_s
        self._offset_m = np.array([sensor.translation_m for sensor in sensors])[before.sensor]
        self._twists = [None if twist is None else twist[None] for twist in twists]

    def pairs(self, reach_m: float, reach_rad: float) -> _EchoPairs:
        """Return the pairs of the same sensor whose range, azimuth and level differ little."""
        before, after = self.before, self.after
        near = before.sensor[:, None] == after.sensor
        near &= np.abs(before.range_m[:, None] - after.range_m) < reach_m
        near &= np.abs(_turn(before.azimuth_rad[:, None] - after.azimuth_rad)) < reach_rad
        near &= np.abs(before.level[:, None] - after.level) < _MAX_LEVEL_CHANGE
        return _EchoPairs(*np.nonzero(near))

    def linear(self, displacement: Floats, pairs: _EchoPairs) -> tuple[Floats, Floats]:
        """Return residuals, and derivatives of the predictions.

        Returns
        -------
        residual : (2, pair) float64
            Observed minus predicted range and azimuth, in metres and radians.
        slopes : (2, pair, 3) float64
        """
        range_m, azimuth_rad = self._predicted(displacement + _TRIALS)
        residual = np.stack(
            [
                self.after.range_m[pairs.after] - range_m[0, pairs.before],
                _turn(self.after.azimuth_rad[pairs.after] - azimuth_rad[0, pairs.before]),
            ]
        )
        slopes = np.stack([range_m[1:4] - range_m[4:], _turn(azimuth_rad[1:4] - azimuth_rad[4:])]) / (2 * _STEP)
        return residual, np.ascontiguousarray(slopes.transpose(0, 2, 1)[:, pairs.before])

    def _predicted(self, displacement: Floats) -> tuple[Floats, Floats]:
        constant = twist_of(displacement, self._time_s)
        first, second = (constant if twist is None else twist for twist in self._twists)
        return _predicted(displacement, self.before, self._offset_m, first, second)

    def strengths(self, pairs: _EchoPairs) -> Floats:
        """Return the weights of pairs in a comparison of displacements: (pair,) float64.

        Flat arrays hear the calls of neighbours from behind as if they came from ahead, and such echoes turn the other
        way. They are as many as others, but weaker, so strong echoes count more: the root of their amplitude.
        """
        levels = [echoes.level - echoes.level.max() for echoes in (self.before, self.after)]
        return np.asarray(np.exp((levels[0][pairs.before] + levels[1][pairs.after]) / 4))

    def deviations(self, pairs: _EchoPairs) -> Floats:
        """Return the standard deviations of residuals: (2, pair) float64."""
        before, after = self.before, self.after
        return np.stack(
            [
                np.hypot(before.range_sd_m[pairs.before], after.range_sd_m[pairs.after]),
                np.hypot(before.azimuth_sd_rad[pairs.before], after.azimuth_sd_rad[pairs.after]),
            ]
        )


def fit_flow(
    before: GroupEchoes,
    after: GroupEchoes,
    sensors: tuple[MountedSensor, ...],
    time_s: float,
    *,
    start: Floats | None = None,
    reach: Floats | None = None,
    first_twist: Floats | None = None,
    second_twist: Floats | None = None,
) -> FlowFit | None:
    """Return the displacement that explains most echoes, or None if there are too few.

    Parameters
    ----------
    before, after : GroupEchoes
    sensors : tuple of MountedSensor
    time_s : float
        Time between both groups.
    start, reach : (3,) float64, optional
        Expected displacement, and the largest difference from it.
    first_twist, second_twist : (3,) float64, optional
        Velocities at both groups, x, y and yaw per second, each in the frame of the platform; by default, those of the
        displacement.
    """
    flow = _Flow(before, after, sensors, time_s, (first_twist, second_twist))
    centre = np.zeros(3) if start is None else start
    limit = np.array([MAX_SPEED_M_S, MAX_SPEED_M_S, MAX_YAW_RATE_RAD_S]) * time_s if reach is None else reach
    reach_m = float(np.hypot(*np.abs(centre[:2]))) + float(np.hypot(*limit[:2])) + 0.05
    reach_rad = float(abs(centre[2]) + limit[2]) + math.radians(15)
    pairs = flow.pairs(reach_m, reach_rad)
    if len(pairs.before) < 4:
        return None
    found = [_annealed(flow, pairs, each) for each in _starts(flow, pairs, centre, limit)]
    strengths = flow.strengths(pairs)
    best, weight = max(found, key=lambda each: float(each[1] @ strengths))
    score = float(weight @ strengths)
    explained = np.bincount(pairs.before, weight, len(before.level))[pairs.before]
    rivals = [
        (displacement, float(weights @ strengths))
        for displacement, weights in found
        if np.any(np.abs(displacement - best) > _ELSEWHERE) and (weights * explained) @ strengths > _SHARED * score
    ]
    other, second = max(rivals, key=lambda each: each[1], default=(best, 0.0))
    fit = _final(flow, pairs, best)
    if fit is None:
        return None
    by_accident = np.sum(_gate_areas(flow, pairs)) / (4 * reach_m * reach_rad)
    fit = fit._replace(n_false_alarms=_n_false_alarms(fit.n_matches, float(by_accident), limit))
    return _with_other(fit, other - best, second / max(score, 1e-30))


def _gate_areas(flow: _Flow, pairs: _EchoPairs) -> Floats:
    """Return the areas of differences of range and azimuth within which pairs match, in m rad: (pair,) float64."""
    return np.asarray(math.pi * _GATE * np.prod(flow.deviations(pairs), axis=0))


def _n_false_alarms(n_matches: int, by_accident: float, limit: Floats) -> float:
    """Return the expected number of displacements that explain as many unrelated echoes.

    Accidental matches of one displacement have a Poisson distribution. The probability of at least ``n_matches`` is
    multiplied by the number of displacements that the search tells apart, as in Moisan and Stival, "A probabilistic
    criterion to detect rigid point matches between two images", Int. J. Computer Vision 57 (2004), 201-218.
    """
    n_displacements = float(np.prod(np.maximum(1.0, 2 * limit / _SEARCH_STEP)))
    return n_displacements * float(scipy.special.gammainc(n_matches, by_accident))


def _with_other(fit: FlowFit, offset: Floats, ambiguity: float) -> FlowFit:
    """Return a fit whose covariance includes another displacement, if that is almost as likely."""
    fit = fit._replace(ambiguity=ambiguity)
    if fit.is_certain:
        return fit
    return fit._replace(covariance=fit.covariance + ambiguity / (1 + ambiguity) * np.outer(offset, offset))


def _starts(flow: _Flow, pairs: _EchoPairs, centre: Floats, limit: Floats) -> Floats:
    """Return the most likely displacements of a grid: (start, 3) float64."""
    counts = np.clip(2 * np.ceil(limit / _SEARCH_STEP).astype(int) + 1, 3, _MAX_STEPS)
    axes = [c + most * np.linspace(-1, 1, n) for c, most, n in zip(centre, limit, counts, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    strong = (_rank(flow.before)[pairs.before] < _STRONGEST) & (_rank(flow.after)[pairs.after] < _STRONGEST)
    pairs = _EchoPairs(pairs.before[strong], pairs.after[strong])
    step = np.array([2 * most / (n - 1) for most, n in zip(limit, counts, strict=True)])
    # The search must not miss displacements between two points of the grid.
    sd = np.maximum(_SEARCH_SD, step[1:] / 2)[:, None]
    residual, slopes = flow.linear(centre, pairs)
    residual, slopes = residual / sd, slopes / sd[:, :, None]
    strength = flow.strengths(pairs)
    score = np.empty(len(grid))
    for part in np.array_split(np.arange(len(grid)), max(1, len(grid) * len(pairs.before) // 500_000)):
        offset = grid[part] - centre
        square = sum((residual[axis][:, None] - slopes[axis] @ offset.T) ** 2 for axis in (0, 1))
        score[part] = strength @ np.maximum(0.0, 1 - square / _GATE) ** 2
    found: list[Floats] = []
    for place in np.argsort(-score):
        if all(np.any(np.abs(grid[place] - other) > 2.5 * step) for other in found):
            found.append(grid[place])
            if len(found) == _N_STARTS:
                break
    return np.array(found)


def _rank(echoes: GroupEchoes) -> NDArray[np.int64]:
    """Return the number of stronger echoes of the same sensor: (echo,) int64."""
    order = np.lexsort((-echoes.level, echoes.sensor))
    sensor = echoes.sensor[order]
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - np.searchsorted(sensor, sensor)
    return rank


def _weights(square: Floats, pairs: _EchoPairs, n_before: int, n_after: int) -> Floats:
    """Return the probability of each pair, in which each echo has at most one partner."""
    likelihood = np.exp(-0.5 * np.minimum(square, 200.0))
    of_before = np.bincount(pairs.before, likelihood, n_before)[pairs.before]
    of_after = np.bincount(pairs.after, likelihood, n_after)[pairs.after]
    return likelihood / (np.maximum(of_before, of_after) + _OUTLIER)


def _annealed(flow: _Flow, pairs: _EchoPairs, displacement: Floats) -> tuple[Floats, Floats]:
    """Return the displacement after a fit with decreasing tolerance, and the probabilities of pairs."""
    sd = flow.deviations(pairs)
    weight = np.zeros(len(pairs.before))
    for scale in (*_SCALES, *([1.0] * _ROUNDS)):
        residual, slopes = flow.linear(displacement, pairs)
        residual, slopes = residual / sd, slopes / sd[:, :, None]
        weight = _weights(np.sum(residual**2, axis=0) / scale**2, pairs, len(flow.before.level), len(flow.after.level))
        step = _solved(slopes, residual, weight)
        displacement = displacement + step
    return displacement, weight


def _solved(slopes: Floats, residual: Floats, weight: Floats) -> Floats:
    normal = np.einsum("apx,p,apy->xy", slopes, weight, slopes)
    right = np.einsum("apx,p,ap->x", slopes, weight, residual)
    ridge = 1e-9 * np.trace(normal) * np.eye(3) + 1e-12 * np.eye(3)
    return np.asarray(np.linalg.solve(normal + ridge, right))


def _final(flow: _Flow, pairs: _EchoPairs, displacement: Floats) -> FlowFit | None:
    """Return the fit to the pairs that remain, with its covariance from their residuals."""
    sd = flow.deviations(pairs)
    residual, slopes = flow.linear(displacement, pairs)
    residual, slopes = residual / sd, slopes / sd[:, :, None]
    n_before, n_after = len(flow.before.level), len(flow.after.level)
    weight = _weights(np.sum(residual**2, axis=0), pairs, n_before, n_after)
    normal = np.einsum("apx,p,apy->xy", slopes, weight, slopes)
    n_matches = int(np.sum(weight > 0.5))
    if n_matches < 3 or np.linalg.matrix_rank(normal, hermitian=True) < 3:
        return None
    spread = np.einsum("apx,p,ap,apy->xy", slopes, weight**2, residual**2, slopes)
    inverse = np.linalg.inv(normal)
    covariance = _INFLATION @ inverse @ spread @ inverse @ _INFLATION
    share = n_matches / max(1, min(n_before, n_after))
    return FlowFit(displacement, covariance, n_matches, share, float(weight @ flow.strengths(pairs)))


def _turn(angle_rad: Floats) -> Floats:
    """Return angles between -π and π."""
    return np.asarray((angle_rad + math.pi) % (2 * math.pi) - math.pi)
