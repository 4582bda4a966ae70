"""Rivals of a motion: standing still, mirrored motion, the motion of objects, and that by the spacing of posts."""

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ertis_numba.fusion.rig import MountedSensor
from ertis_numba.motion.hypotheses import NEAR_SCALES, MotionHypothesis, hypothesis
from ertis_numba.motion.residuals import EchoFlow, EchoPairs

__all__ = ["ELSEWHERE", "MAX_AMBIGUITY", "worst_rival"]

Floats = NDArray[np.float64]

# In simulated rooms, correct displacements had ambiguities of at most 0.65. Wrong ones, by the spacing of equal posts,
# had at least 0.75, as one post of four without a partner.
MAX_AMBIGUITY: Final = 0.7
ELSEWHERE: Final = np.array([0.02, 0.02, math.radians(2.0)])
"""Differences of displacements, in metres, metres and radians, that are not the same."""
# Share of the echoes that a rival must explain otherwise, to be compared by all of its echoes.
_SHARED: Final = 0.2
# Rivals of other echoes are compared by the places of these echoes. The reflectors at rest are unknown if another
# motion explains more than the first share of what the best one explains, and more than the second share of its
# echoes. If all arrays face along one line, echoes from behind agree with one motion, which needs lower limits.
_MAX_SUPPORT: Final = 0.5
_MAX_SUPPORT_ONE_LINE: Final = 0.3
_MIN_MATCHES: Final = 0.3
_MAX_ACCIDENTAL: Final = 0.02  # Expected number of rivals by accident
_N_NEAR: Final = 33.0  # Displacements that a fit tells apart near its start.
_MIN_PLACES: Final = 3  # of echoes that rule out reflectors behind arrays
_PARALLEL: Final = 0.98  # Cosine of arrays that face along one line


def worst_rival(
    flow: EchoFlow,
    pairs: EchoPairs,
    best: MotionHypothesis,
    found: Sequence[MotionHypothesis],
    sensors: tuple[MountedSensor, ...],
    by_accident: float,
    expected: tuple[Floats, Floats] | None,
) -> tuple[Floats, float]:
    """Return the displacement that rivals the best one most, and its score relative to the best one."""
    # Echoes from behind a flat array agree with the mirrored motion, a rival if it explains more than `by_accident`.
    mirrored = [_mirrored(best.displacement, sensor) for sensor in _facing(flow, pairs, sensors)]
    rivals = [*found, *(hypothesis(flow, pairs, each, NEAR_SCALES) for each in mirrored)]
    judged = [(each.displacement, _ambiguity(flow, pairs, best, each, by_accident, mirrored)) for each in rivals]
    behind = _behind(flow, pairs, best, sensors, by_accident)
    judged += [each for each in behind if expected is None or np.all(np.abs(each[0] - expected[0]) < expected[1])]
    return max(judged, key=lambda each: each[1])


def _behind(
    flow: EchoFlow,
    pairs: EchoPairs,
    best: MotionHypothesis,
    sensors: tuple[MountedSensor, ...],
    by_accident: float,
) -> Iterator[tuple[Floats, float]]:
    """Yield displacements by which reflectors are behind some arrays, where no other sensor shows them, as rivals."""
    is_match = (best.weight > 0.5) & flow.before.may_be_behind[pairs.before]
    numbers, counts = np.unique(flow.before.sensor[pairs.before[is_match]], return_counts=True)
    if counts.sum() <= _MIN_MATCHES * best.n_matches:
        return
    for chosen in {(*numbers,), *((number,) for number in numbers)}:
        mirrored = flow.behind(np.array(chosen))
        for number in chosen:
            rival = hypothesis(mirrored, pairs, _mirrored(best.displacement, sensors[number]), NEAR_SCALES)
            if np.any(np.abs(rival.displacement - best.displacement) > ELSEWHERE / 3):
                only_best = best.without(_explained(flow, pairs, rival) > 0.5, flow, pairs)
                only_rival = rival.without(_explained(flow, pairs, best) > 0.5, mirrored, pairs)
                is_sure = only_best.n_places >= _MIN_PLACES and _n_accidental(only_best, by_accident) < _MAX_ACCIDENTAL
                better, worse = (only_best, only_rival) if is_sure else (best, rival)
                yield rival.displacement, MAX_AMBIGUITY * worse.support / better.support / _MAX_SUPPORT


def _explained(flow: EchoFlow, pairs: EchoPairs, found: MotionHypothesis) -> Floats:
    """Return the probability that a hypothesis explains the first echo of each pair: (pair,) float64."""
    return np.asarray(np.bincount(pairs.before, found.weight, len(flow.before.level))[pairs.before])


def _n_accidental(found: MotionHypothesis, by_accident: float) -> float:
    """Return the expected number of hypotheses near a given one that explain as many unrelated echoes."""
    return _N_NEAR * float(scipy.special.gammainc(found.n_matches, by_accident))


def _facing(flow: EchoFlow, pairs: EchoPairs, sensors: tuple[MountedSensor, ...]) -> list[MountedSensor]:
    """Return one sensor with echoes for each line along which arrays face."""
    found: list[MountedSensor] = []
    for number in np.unique(flow.before.sensor[pairs.before]):
        axis = sensors[number].rotation[:, 0]
        if all(abs(axis @ other.rotation[:, 0]) < _PARALLEL for other in found):
            found.append(sensors[number])
    return found


def _ambiguity(
    flow: EchoFlow,
    pairs: EchoPairs,
    best: MotionHypothesis,
    rival: MotionHypothesis,
    by_accident: float,
    mirrored: Sequence[Floats],
) -> float:
    apart = np.abs(rival.displacement - best.displacement)
    if np.all(apart < ELSEWHERE / 3):
        return 0.0
    strengths = flow.strengths(pairs)
    score = float(best.weight @ strengths)
    explained = _explained(flow, pairs, best)
    shared = 0.0
    if np.any(apart > ELSEWHERE) and (rival.weight * explained) @ strengths > _SHARED * score:
        shared = float(rival.weight @ strengths) / max(score, 1e-30)
    return max(shared, _ambiguity_of_others(best, rival.without(explained > 0.5, flow, pairs), by_accident, mirrored))


def _ambiguity_of_others(
    best: MotionHypothesis, rival: MotionHypothesis, by_accident: float, mirrored: Sequence[Floats]
) -> float:
    """Return the ambiguity by a rival that explains other echoes."""
    if rival.n_matches <= _MIN_MATCHES * best.n_matches or _n_accidental(rival, by_accident) > _MAX_ACCIDENTAL:
        return 0.0
    if len(mirrored) > 1 and any(_is_near(rival.displacement, each, best.displacement) for each in mirrored):
        return 0.0  # Calls of others from behind agree with the best one, unless all of its echoes are from behind.
    relative = max(rival.support / best.support, rival.n_places / best.n_places)
    return MAX_AMBIGUITY * relative / (_MAX_SUPPORT_ONE_LINE if len(mirrored) == 1 else _MAX_SUPPORT)


def _is_near(displacement: Floats, mirrored: Floats, best: Floats) -> bool:
    """Return True if a displacement is the mirrored one, rather than the best or any other."""
    away, apart = (float(np.max(np.abs(each - mirrored) / ELSEWHERE)) for each in (displacement, best))
    return away < min(2.0, max(0.5, 0.4 * apart))


def _mirrored(displacement: Floats, sensor: MountedSensor) -> Floats:
    """Return a displacement as it appears to a flat array if all reflectors are behind it: (3,) float64."""
    normal = sensor.rotation[:2, 0] / max(float(np.hypot(*sensor.rotation[:2, 0])), 1e-9)
    x_m, y_m = sensor.translation_m[:2].tolist()
    yaw = float(displacement[2])
    c, s = math.cos(yaw), math.sin(yaw)
    way_m = displacement[:2] + np.array([c * x_m - s * y_m - x_m, s * x_m + c * y_m - y_m])  # of the sensor
    way_m = way_m - 2 * (way_m @ normal) * normal
    return np.array([*(way_m - [c * x_m + s * y_m - x_m, -s * x_m + c * y_m - y_m]), -yaw])
