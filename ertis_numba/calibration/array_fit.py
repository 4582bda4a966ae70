"""Least-squares fit of an array to the times and levels of many sounds."""

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.calibration.observations import Observations, Tolerances
from ertis_numba.calibration.separable_problem import MM, US, SeparableProblem
from ertis_numba.calibration.wavefronts import Target, travel_times

__all__ = ["ArrayFit", "fit_array", "fit_gains"]

_NEPER_IN_DB = math.log(10) / 20
_ROBUST_ROUNDS = 3
_ROBUST_FROM = 3.0  # Standard deviations from which on residuals lose weight.
_MEDIAN_OF_NORMAL = 0.6745  # of the magnitude, in standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class ArrayFit:
    """Delays and positions of microphones, and positions of sources."""

    delay_s: NDArray[np.float64]
    positions_m: NDArray[np.float64]
    source_m: NDArray[np.float64]  # (record, axis)
    distance_m: NDArray[np.float64]  # (record, mic) from the source to the microphone
    residual_s: NDArray[np.float64]  # (record, mic), measured minus fitted times
    covariance: NDArray[np.float64]  # (4 mic, 4 mic) of delay in µs and x, y, z in mm, microphone by microphone


def fit_array(
    seen: Observations,
    delay_s: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    source_m: NDArray[np.float64],
    speed_m_s: NDArray[np.float64],
    target: Target,
    expected: Tolerances,
) -> ArrayFit:
    """Fit delays, positions and sources to times of arrival, starting at the layout and approximate sources.

    The fit minimises ``Σ ρ((t − τ − T(s, x)) / σ)`` with the travel times T of `travel_times`, plus the squared changes
    of τ and x relative to the expected deviations. ρ is quadratic for small residuals and linear for large ones. The
    covariance is the inverse of the Fisher information with the priors, without what no recording can observe: the
    common delay, a translation and a rotation of the array.
    """
    problem = SeparableProblem(seen, delay_s, positions_m, source_m, speed_m_s, target, expected)
    source_mm = problem.start_mm
    for _ in range(_ROBUST_ROUNDS):
        # Residuals of the start exceed the noise a thousandfold, so the first round has equal weights.
        found = scipy.optimize.least_squares(
            problem.residuals, source_mm, jac=problem.jacobian, x_scale="jac", xtol=1e-10, ftol=1e-8, gtol=1e-10
        )
        source_mm = found.x
        standard = problem.solution(source_mm).residual_s / seen.time_sd_s
        size = (
            max(1.0, float(np.nanmedian(np.abs(standard))) / _MEDIAN_OF_NORMAL) if np.isfinite(standard).any() else 1.0
        )
        problem.reweigh((1 + (np.nan_to_num(standard) / (_ROBUST_FROM * size)) ** 2) ** -0.25)
    own, source, residual_s = problem.solution(source_mm)
    # Residuals beyond the noise, such as those of overlapping echoes, widen the intervals.
    _, n_determined = problem.covariance(source_mm, 1.0)
    factor = max(1.0, _mean_square(standard[np.isfinite(standard)], np.isfinite(standard).sum() - n_determined))
    fitted, _ = problem.covariance(source_mm, factor)
    n_mics, n_own = own.shape
    of_mics = np.zeros((n_mics, 4, n_mics, 4))
    of_mics[:, :n_own, :, :n_own] = fitted
    changed_m = positions_m + (MM * own[:, 1:] if n_own > 1 else 0.0)
    distance_m = travel_times(source, changed_m, speed_m_s, target).distance_m
    if n_own > 1:
        changed_m, turn = _turned_onto(changed_m, positions_m)
        source = source @ turn.T
    return ArrayFit(
        delay_s=delay_s + US * (own[:, 0] - own[:, 0].mean()),
        positions_m=changed_m,
        source_m=source,
        distance_m=distance_m,
        residual_s=residual_s,
        covariance=_without_gauge(of_mics.reshape(4 * n_mics, 4 * n_mics), changed_m, turns=n_own > 1),
    )


def _mean_square(rest: NDArray[np.float64], freedom: float) -> float:
    """Return the mean square of residuals without the effect of outliers."""
    if not len(rest):
        return 1.0
    clipped = np.minimum(np.abs(rest), 6 * np.median(np.abs(rest)))
    return float(np.sum(clipped**2)) / max(1.0, freedom)


def _turned_onto(
    moved_m: NDArray[np.float64], positions_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions after the rotation and shift that bring them nearest to others, and the rotation matrix."""
    centre_m = positions_m.mean(axis=0)
    centred_m = moved_m - moved_m.mean(axis=0)
    rotation, _ = scipy.spatial.transform.Rotation.align_vectors(positions_m - centre_m, centred_m)
    return rotation.apply(centred_m) + centre_m, rotation.as_matrix()


def _without_gauge(
    covariance: NDArray[np.float64], positions_m: NDArray[np.float64], *, turns: bool
) -> NDArray[np.float64]:
    """Return the covariance without a common delay, and without translations and rotations: (4 mic, 4 mic) float64."""
    n_mics = len(positions_m)
    directions = np.zeros((n_mics, 4, 7))
    directions[:, 0, 0] = 1.0
    if turns:
        centred_m = positions_m - positions_m.mean(axis=0)
        for axis, about in enumerate(np.eye(3)):
            directions[:, 1 + axis, 1 + axis] = 1.0
            directions[:, 1:, 4 + axis] = np.cross(about, centred_m) / MM
    basis, size, _ = np.linalg.svd(directions.reshape(4 * n_mics, 7), full_matrices=False)
    basis = basis[:, size > 1e-9 * size.max()]
    within = covariance @ basis
    return np.asarray(covariance - within @ basis.T - basis @ within.T + basis @ (basis.T @ within) @ basis.T)


def fit_gains(
    seen: Observations,
    former_np: NDArray[np.float64],
    distance_m: NDArray[np.float64],
    absorption_1_m: float,
    expected: Tolerances,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fit gains to levels; return their changes and covariance in Np, and residuals (record, mic) in Np.

    The level is ``ln |a| = γ + A − ln d − α d``: gain of the microphone, level of the recording, spreading and
    absorption (Np/m) over the distance d. Priors are normal, levels that fit badly lose weight (Cauchy), and the mean
    change of γ is 0, because no recording can observe a common gain. Residuals are NaN for values that are left out.
    """
    known = np.isfinite(seen.level_sd)
    level = np.log(np.where(known, np.abs(seen.level), 1.0)) + np.log(distance_m) + absorption_1_m * distance_m
    level = level - former_np
    prior = np.eye(level.shape[1]) / (expected.gain_db * _NEPER_IN_DB) ** 2
    n_records, n_mics = level.shape
    precision = np.where(known, 1 / np.where(known, seen.level_sd, 1.0), 0.0)
    robust = np.ones_like(level)
    gain, common = np.zeros(n_mics), np.zeros(n_records)
    projector = np.eye(n_mics) - 1 / n_mics
    inverse, rest = np.zeros((n_mics, n_mics)), np.zeros_like(level)
    for _ in range(10):
        weight = (precision * robust) ** 2
        per_record = np.maximum(weight.sum(axis=1), 1e-300)
        # The levels of recordings are eliminated, which leaves the Schur complement for the gains.
        schur = np.diag(weight.sum(axis=0)) - weight.T @ (weight / per_record[:, None])
        inverse = np.linalg.inv(schur + prior)
        centred = level - (np.sum(weight * level, axis=1) / per_record)[:, None]
        gain = projector @ inverse @ np.sum(weight * centred, axis=0)
        common = np.sum(weight * (level - gain), axis=1) / per_record
        rest = level - gain - common[:, None]
        size = np.median(np.abs(rest * precision)[known]) if known.any() else 1.0
        robust = 1 / np.sqrt(1 + (rest * precision / max(3 * float(size), 1e-12) / 1.5) ** 2)
    freedom = max(1, int(known.sum()) - n_mics - n_records)
    factor = max(1.0, _mean_square((rest * precision)[known], freedom))
    return gain, factor * projector @ inverse @ projector, np.where(known, rest, np.nan)
