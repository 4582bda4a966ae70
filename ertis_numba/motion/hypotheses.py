"""Hypotheses of the motion of a platform, and the echoes and places that they explain."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.motion.residuals import EchoFlow, EchoPairs

__all__ = ["FAR_SCALES", "NEAR_SCALES", "MotionHypothesis", "hypothesis", "pair_weights", "refined"]

Floats = NDArray[np.float64]

FAR_SCALES: Final = 8.0, 5.0, 3.0, 2.0, 1.4, 1.0
"""Tolerances of fits that begin at a point of the search, in standard deviations."""
NEAR_SCALES: Final = 3.0, 2.0, 1.4, 1.0
"""Tolerances of fits that begin at a motion that may be the right one."""
_ROUNDS: Final = 8
_CONVERGED: Final = 1e-6  # m and rad
_REACH: Final = 8.0  # Largest residual of a pair that a fit may use, in standard deviations and tolerances
_OUTLIER: Final = math.exp(-0.5 * 9.0)  # Likelihood of an echo without a partner: three standard deviations.
# All echoes of a person are within this distance, so they are evidence of one place only.
PLACE_M: Final = 0.7
# Smooth walls reflect from their nearest point, which moves with the platform, so that it seems to stand still.
_BESIDE_M: Final = 0.25


class MotionHypothesis(NamedTuple):
    """Displacement, and the echoes that it explains."""

    displacement: Floats
    weight: Floats  # (pair,) probability of each pair
    n_matches: int
    n_places: int  # at least 0.7 m apart; those on one line through the platform count as one
    support: float  # sum of the strengths of the strongest echoes of all places

    def without(self, explained: NDArray[np.bool_], flow: EchoFlow, pairs: EchoPairs) -> "MotionHypothesis":
        """Return the hypothesis with its other pairs only."""
        return _described(flow, pairs, self.displacement, np.where(explained, 0.0, self.weight))


def hypothesis(
    flow: EchoFlow, pairs: EchoPairs, start: Floats, scales: tuple[float, ...] = FAR_SCALES
) -> MotionHypothesis:
    """Return the hypothesis to which a fit from a displacement leads."""
    return _described(flow, pairs, *refined(flow, pairs, start, scales))


def _described(flow: EchoFlow, pairs: EchoPairs, displacement: Floats, weight: Floats) -> MotionHypothesis:
    is_match = weight > 0.5
    strength = flow.strengths(pairs)[is_match]
    order = np.argsort(-strength, kind="stable")
    place_m, strength = flow.before.position_m[pairs.before[is_match], :2][order], strength[order]
    support, places_m = 0.0, []
    while len(place_m):
        places_m.append(place_m[0])
        support += float(strength[0])
        is_far = np.hypot(*(place_m - place_m[0]).T) > PLACE_M
        place_m, strength = place_m[is_far], strength[is_far]
    return MotionHypothesis(displacement, weight, len(order), _n_independent(places_m), support)


def _n_independent(places_m: list[Floats]) -> int:
    """Return the number of places; one if all lie on a line through the platform, as mirror images of walls do."""
    if not places_m:
        return 0
    beside_m = np.linalg.svd(np.array(places_m), compute_uv=False)[-1] / math.sqrt(len(places_m))
    return 1 if beside_m < _BESIDE_M else len(places_m)


def refined(flow: EchoFlow, pairs: EchoPairs, displacement: Floats, scales: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Return the displacement after a fit with decreasing tolerance, and the probabilities of pairs."""
    residual, _ = flow.linear(displacement, pairs)
    square = np.sum((residual / flow.deviations(pairs)) ** 2, axis=0)
    near = np.flatnonzero(square < (_REACH * scales[0]) ** 2)  # Other pairs would only take time.
    close = EchoPairs(pairs.before[near], pairs.after[near])
    sd = flow.deviations(close)
    weight = np.zeros(len(near))
    for scale in (*scales, *([1.0] * _ROUNDS)):
        residual, slopes = flow.linear(displacement, close)
        residual, slopes = residual / sd, slopes / sd[:, :, None]
        weight = pair_weights(np.sum(residual**2, axis=0) / scale**2, flow, close)
        step = _solved(slopes, residual, weight)
        displacement = displacement + step
        if scale == 1.0 and np.all(np.abs(step) < _CONVERGED):
            break
    weights = np.zeros(len(pairs.before))
    weights[near] = weight
    return displacement, weights


def pair_weights(square: Floats, flow: EchoFlow, pairs: EchoPairs) -> Floats:
    """Return the probability of each pair, in which each echo has at most one partner."""
    likelihood = np.exp(-0.5 * np.minimum(square, 200.0))
    of_before = np.bincount(pairs.before, likelihood, len(flow.before.level))[pairs.before]
    of_after = np.bincount(pairs.after, likelihood, len(flow.after.level))[pairs.after]
    return np.asarray(likelihood / (np.maximum(of_before, of_after) + _OUTLIER))


def _solved(slopes: Floats, residual: Floats, weight: Floats) -> Floats:
    normal = np.einsum("apx,p,apy->xy", slopes, weight, slopes)
    right = np.einsum("apx,p,ap->x", slopes, weight, residual)
    ridge = 1e-9 * np.trace(normal) * np.eye(3) + 1e-12 * np.eye(3)
    return np.asarray(np.linalg.solve(normal + ridge, right))
