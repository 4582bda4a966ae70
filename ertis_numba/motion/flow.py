"""Robust fit of the motion of a platform to the flow of echoes."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ertis_numba.fusion.rig import MountedSensor
from ertis_numba.motion.echoes import GroupEchoes
from ertis_numba.motion.hypotheses import NEAR_SCALES, PLACE_M, hypothesis, pair_weights
from ertis_numba.motion.residuals import EchoFlow, EchoPairs
from ertis_numba.motion.rivals import ELSEWHERE, MAX_AMBIGUITY, worst_rival

__all__ = ["FlowFit", "fit_flow"]

Floats = NDArray[np.float64]

MAX_SPEED_M_S: Final = 2.0
MAX_YAW_RATE_RAD_S: Final = math.radians(120.0)
_SEARCH_STEP: Final = np.array([0.0125, 0.0125, math.radians(1.25)])  # of x, y and yaw, below _SEARCH_SD
_MAX_STEPS: Final = 17  # per axis; larger reaches have larger steps.
_SEARCH_SD: Final = 0.02, math.radians(2.0)
_N_STARTS: Final = 6
_N_STARTS_NEAR: Final = 3  # of searches near an expected displacement
# One object, such as a person who walks by, shows in up to two places in the image of one sensor, and in up to three
# in those of several sensors. They must not count as the surroundings of a platform at rest. It is unlikely that they
# move as the surroundings did before.
_MIN_PLACES: Final = 3
_MIN_PLACES_OF_SENSORS: Final = 4
# Expected number of motions by which unrelated groups match as well; an upper limit of the rate of false alarms.
_MAX_FALSE_ALARMS: Final = 1e-3
_STRONGEST: Final = 40  # Number of echoes per sensor that the search uses.
_GATE: Final = 9.0
_MIN_WEIGHT: Final = 0.01  # of pairs that count as echoes of a place
_MIN_VARIANCE: Final = 0.003  # of residuals, relative to that by the deviations of echoes
# Errors of neighbouring echoes are correlated, so residuals underestimate those of the motion by these factors. They
# were measured in simulated rooms other than those of `ertis bench motion`.
_INFLATION: Final = np.diag([1.25, 1.25, 1.6])


class FlowFit(NamedTuple):
    """Displacement of a platform between two groups of echoes, with the echoes that it explains."""

    displacement: Floats  # x, y in m and yaw in rad, in the platform's frame at the first group
    covariance: Floats  # (3, 3)
    n_matches: int  # explained echoes
    share: float  # of echoes that are explained
    score: float  # sum of the strengths of the strongest echoes of all places
    ambiguity: float  # score of the strongest rival, relative to this
    other: Floats  # displacement of this rival
    n_false_alarms: float  # expected displacements that explain as many unrelated echoes
    n_places: int  # of explained echoes, at least 0.7 m apart
    has_places: bool  # more places than those of one moving object

    @property
    def is_significant(self) -> bool:
        """True if neither unrelated groups nor those of one moving object match as well."""
        return self.n_false_alarms < _MAX_FALSE_ALARMS and self.has_places

    @property
    def is_certain(self) -> bool:
        """True if no other displacement explains as much."""
        return self.ambiguity < MAX_AMBIGUITY


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
    suspects: Sequence[Floats] = (),
) -> FlowFit | None:
    """Return the displacement that explains most echoes, or None if there are too few."""
    # Vectors are x, y in m and yaw in rad. `suspects` are other displacements that may be right.
    flow = EchoFlow(before, after, sensors, time_s, (first_twist, second_twist))
    centre = np.zeros(3) if start is None else start
    limit = np.array([MAX_SPEED_M_S, MAX_SPEED_M_S, MAX_YAW_RATE_RAD_S]) * time_s if reach is None else reach
    reach_m = float(np.hypot(*np.abs(centre[:2]))) + float(np.hypot(*limit[:2])) + 0.05
    reach_rad = float(abs(centre[2]) + limit[2]) + math.radians(15)
    pairs = flow.pairs(reach_m, reach_rad)
    if len(pairs.before) < 4:
        return None
    found = [
        hypothesis(flow, pairs, each)
        for each in _starts(flow, pairs, centre, limit, _N_STARTS if start is None else _N_STARTS_NEAR)
    ]
    # Standing still is more likely than its neighbours.
    found += [hypothesis(flow, pairs, each, NEAR_SCALES) for each in (np.zeros(3), *suspects)]
    best = max(found, key=lambda each: each.support)
    fitted = _covariance(flow, pairs, best.displacement)
    if fitted is None:
        return None
    covariance, n_matches = fitted
    by_accident = float(np.sum(_gate_areas(flow, pairs)) / (4 * reach_m * reach_rad))
    is_expected = start is not None and bool(np.all(np.abs(best.displacement - start) < ELSEWHERE))
    min_places = _MIN_PLACES if is_expected or len(np.unique(before.sensor)) == 1 else _MIN_PLACES_OF_SENSORS
    expected = None if start is None else (start, limit)
    other, ambiguity = worst_rival(flow, pairs, best, found, sensors, by_accident, expected)
    if ambiguity >= MAX_AMBIGUITY:
        offset = other - best.displacement
        covariance = covariance + ambiguity / (1 + ambiguity) * np.outer(offset, offset)
    return FlowFit(
        displacement=best.displacement,
        covariance=covariance,
        n_matches=n_matches,
        share=n_matches / max(1, min(len(before.level), len(after.level))),
        score=best.support,
        ambiguity=ambiguity,
        other=other,
        n_false_alarms=_n_false_alarms(n_matches, by_accident, limit),
        n_places=best.n_places,
        has_places=best.n_places >= min_places,
    )


def _gate_areas(flow: EchoFlow, pairs: EchoPairs) -> Floats:
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


def _starts(flow: EchoFlow, pairs: EchoPairs, centre: Floats, limit: Floats, n_starts: int) -> Floats:
    """Return the most likely displacements of a grid: (start, 3) float64."""
    counts = np.clip(2 * np.ceil(limit / _SEARCH_STEP).astype(int) + 1, 3, _MAX_STEPS)
    axes = [c + most * np.linspace(-1, 1, n) for c, most, n in zip(centre, limit, counts, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    strong = (_rank(flow.before)[pairs.before] < _STRONGEST) & (_rank(flow.after)[pairs.after] < _STRONGEST)
    pairs = EchoPairs(pairs.before[strong], pairs.after[strong])
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
            if len(found) == n_starts:
                break
    return np.array(found)


def _rank(echoes: GroupEchoes) -> NDArray[np.int64]:
    """Return the number of stronger echoes of the same sensor: (echo,) int64."""
    order = np.lexsort((-echoes.level, echoes.sensor))
    sensor = echoes.sensor[order]
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - np.searchsorted(sensor, sensor)
    return rank


def _covariance(flow: EchoFlow, pairs: EchoPairs, displacement: Floats) -> tuple[Floats, int] | None:
    """Return the covariance by the residuals of matches, and their number; None if they do not determine the motion."""
    sd = flow.deviations(pairs)
    residual, slopes = flow.linear(displacement, pairs)
    residual, slopes = residual / sd, slopes / sd[:, :, None]
    weight = pair_weights(np.sum(residual**2, axis=0), flow, pairs)
    normal = np.einsum("apx,p,apy->xy", slopes, weight, slopes)
    n_matches = int(np.sum(weight > 0.5))
    if n_matches < 3 or np.linalg.matrix_rank(normal, hermitian=True) < 3:
        return None
    spread = np.einsum("apx,p,ap,apy->xy", slopes, weight**2, residual**2, slopes)
    # A fit of three parameters to few echoes leaves residuals that are too small.
    spread = spread * 2 * n_matches / (2 * n_matches - 3) + _MIN_VARIANCE * normal
    # Echoes of one place have errors in common, such as those of several calls from one reflector.
    place = _place_of(flow.before.position_m[pairs.before, :2], weight)
    pulls = np.zeros((place.max(initial=0) + 1, 3))
    np.add.at(pulls, place, np.einsum("apx,p,ap->px", slopes, weight, residual))
    common = max(1.0, float(np.trace(np.linalg.solve(spread, pulls.T @ pulls))) / 3)
    inverse = np.linalg.inv(normal)
    return common * _INFLATION @ inverse @ spread @ inverse @ _INFLATION, n_matches


def _place_of(position_m: Floats, weight: Floats) -> NDArray[np.int64]:
    """Return the number of the place of each pair: (pair,) int64."""
    place, left = np.zeros(len(position_m), np.int64), weight > _MIN_WEIGHT
    while left.any():
        strongest = position_m[np.argmax(np.where(left, weight, 0.0))]
        is_here = left & (np.hypot(*(position_m - strongest).T) < PLACE_M)
        place[is_here] = place.max() + 1
        left &= ~is_here
    return place
