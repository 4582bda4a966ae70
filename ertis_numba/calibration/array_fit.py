"""Least-squares fit of an array to the times and levels of many sounds."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.calibration.wavefronts import Target, travel_times

__all__ = ["ArrayFit", "Observations", "Tolerances", "fit_array", "fit_gains"]

_NEPER_IN_DB = math.log(10) / 20
_US, _MM = 1e-6, 1e-3  # The unknowns are in microseconds and millimetres, so that their sizes are alike.


class Tolerances(NamedTuple):
    """Standard deviations that are expected before the calibration.

    Attributes
    ----------
    gain_db : float
        Of gains, in decibels.
    delay_s : float
        Of delays, in seconds.
    position_m : float
        Of positions along each axis, in metres; 0 if the positions of the layout are exact.
    """

    gain_db: float
    delay_s: float
    position_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Times of arrival in some recordings.

    Attributes
    ----------
    time_s : (record, mic) float64
    time_sd_s : (record, mic) float64
        Standard deviations; infinite for values that are left out.
    level : (record, mic) float64
        Amplitudes; only their ratios within a recording matter.
    level_sd : (record, mic) float64
        Relative standard deviations of the amplitudes; infinite for values that are left out.
    """

    time_s: NDArray[np.float64]
    time_sd_s: NDArray[np.float64]
    level: NDArray[np.float64]
    level_sd: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ArrayFit:
    """Delays and positions of microphones, and sources.

    Attributes
    ----------
    delay_s : (mic,) float64
    positions_m : (mic, axis) float64
    source_m : (record, axis) float64
    distance_m : (record, mic) float64
        Distances from the sources to the microphones.
    residual_s : (record, mic) float64
        Measured minus fitted times.
    covariance : (4 mic, 4 mic) float64
        Covariance of the delay in µs and the position x, y, z in mm of each microphone, in this order.
    """

    delay_s: NDArray[np.float64]
    positions_m: NDArray[np.float64]
    source_m: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    residual_s: NDArray[np.float64]
    covariance: NDArray[np.float64]


def fit_array(
    seen: Observations,
    delay_s: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    source_m: NDArray[np.float64],
    speed_m_s: NDArray[np.float64],
    target: Target,
    expected: Tolerances,
) -> ArrayFit:
    """Fit delays, positions and sources to times of arrival.

    The fit minimises ``Σ ρ((t − τ − T(s, x)) / σ)`` with the travel times T of `travel_times`, plus the squared changes
    of τ and x relative to the expected deviations. It is the maximum of the posterior density with normal priors. ρ is
    quadratic for small residuals and linear for large ones (``soft_l1`` of `scipy.optimize.least_squares`).

    The covariance is the inverse of the Fisher information, including that of the priors, for delays and positions
    after removing what no recording can observe: the common delay, a translation and a rotation of the array.

    Parameters
    ----------
    seen : Observations
    delay_s : (mic,) float64
        Delays of the layout.
    positions_m : (mic, axis) float64
        Positions of the layout.
    source_m : (record, axis) float64
        First approximation of the sources.
    speed_m_s : (record,) float64
    target : {"reflector", "wall", "direct", "beacon"}
    expected : Tolerances
    """
    problem = _Problem(seen, delay_s, positions_m, source_m, speed_m_s, target, expected)
    unknown = problem.start()
    # Residuals of the start exceed the noise a thousandfold, where the robust loss would hardly converge.
    for loss in ("linear", "soft_l1"):
        found = scipy.optimize.least_squares(
            problem.residuals,
            unknown,
            jac=problem.jacobian,
            loss=loss,
            f_scale=3.0,
            x_scale="jac",
            xtol=1e-10,
            ftol=1e-6,
            gtol=1e-10,
            max_nfev=50,
        )
        unknown = found.x
    later_us, moved_mm, source = problem.split(found.x)
    slopes = problem.jacobian(found.x)
    rest = problem.residuals(found.x)[: problem.n_times]
    inverse = _inverse(slopes)
    # Residuals beyond the noise, such as those of overlapping echoes, widen the intervals.
    freedom = max(
        1.0, problem.n_seen - float(np.sum(inverse * (slopes[: problem.n_times].T @ slopes[: problem.n_times])))
    )
    factor = max(1.0, _mean_square(rest, freedom))
    slopes[: problem.n_times] /= math.sqrt(factor)
    inverse = _inverse(slopes)
    n_mics = len(delay_s)
    of_mics = np.zeros((n_mics, 4, n_mics, 4))
    n_own = n_mics * problem.n_own
    of_mics[:, : problem.n_own, :, : problem.n_own] = inverse[:n_own, :n_own].reshape(
        n_mics, problem.n_own, n_mics, problem.n_own
    )
    changed_m = positions_m + _MM * moved_mm
    distance_m = travel_times(source, changed_m, speed_m_s, target).distance_m
    if problem.n_own > 1:
        changed_m, turn = _turned_onto(changed_m, positions_m)
        source = source @ turn.T
    projector = _without_gauge(changed_m, turns=problem.n_own > 1)
    covariance = projector @ of_mics.reshape(4 * n_mics, 4 * n_mics) @ projector.T
    return ArrayFit(
        delay_s=delay_s + _US * (later_us - later_us.mean()),
        positions_m=changed_m,
        source_m=source,
        distance_m=distance_m,
        residual_s=np.where(np.isfinite(seen.time_sd_s), problem.rest_s(found.x), np.nan),
        covariance=covariance,
    )


def _inverse(slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of the Fisher information."""
    information = slopes.T @ slopes
    # Columns of equal length keep the inverse exact; the priors make it exist.
    length = np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information / np.outer(length, length)) / np.outer(length, length))


def _mean_square(rest: NDArray[np.float64], freedom: float) -> float:
    """Return the robust mean square of residuals, of which many may be 0 because they are left out."""
    found = rest[rest != 0]
    if not len(found):
        return 1.0
    clipped = np.minimum(np.abs(found), 6 * np.median(np.abs(found)))
    return float(np.sum(clipped**2)) / freedom


def _turned_onto(
    moved_m: NDArray[np.float64], positions_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions after the rotation and shift that bring them nearest to others, and the rotation matrix."""
    centre_m = positions_m.mean(axis=0)
    centred_m = moved_m - moved_m.mean(axis=0)
    rotation, _ = scipy.spatial.transform.Rotation.align_vectors(positions_m - centre_m, centred_m)
    return rotation.apply(centred_m) + centre_m, rotation.as_matrix()


def _without_gauge(positions_m: NDArray[np.float64], *, turns: bool) -> NDArray[np.float64]:
    """Return the projection that removes a common delay, and translations and rotations: (4 mic, 4 mic) float64."""
    n_mics = len(positions_m)
    directions = np.zeros((n_mics, 4, 7))
    directions[:, 0, 0] = 1.0
    if turns:
        centred_m = positions_m - positions_m.mean(axis=0)
        for axis, about in enumerate(np.eye(3)):
            directions[:, 1 + axis, 1 + axis] = 1.0
            directions[:, 1:, 4 + axis] = np.cross(about, centred_m) / _MM
    basis, size, _ = np.linalg.svd(directions.reshape(4 * n_mics, 7), full_matrices=False)
    basis = basis[:, size > 1e-9 * size.max()]
    return np.asarray(np.eye(4 * n_mics) - basis @ basis.T)


class _Problem:
    """Residuals and Jacobian of the fit; the unknowns are delay and position of each microphone, then the sources."""

    def __init__(
        self,
        seen: Observations,
        delay_s: NDArray[np.float64],
        positions_m: NDArray[np.float64],
        source_m: NDArray[np.float64],
        speed_m_s: NDArray[np.float64],
        target: Target,
        expected: Tolerances,
    ) -> None:
        self._seen, self._delay_s, self._positions_m = seen, delay_s, positions_m
        self._source_m, self._speed_m_s, self._target = source_m, speed_m_s, target
        self.n_records, self.n_mics = seen.time_s.shape
        self.n_own = 4 if expected.position_m > 0 else 1
        self.n_times = self.n_records * self.n_mics
        self.n_seen = int(np.isfinite(seen.time_sd_s).sum())
        self.n_of_mics = self.n_mics * self.n_own
        self.n_unknown = self.n_of_mics + 3 * self.n_records
        self._precision_us = np.where(np.isfinite(seen.time_sd_s), _US / seen.time_sd_s, 0.0)
        sizes = [expected.delay_s / _US, *(3 * [expected.position_m / _MM])][: self.n_own]
        # A line of microphones does not determine the angle around it, so sources have a prior, though a weak one.
        around = np.repeat(np.linalg.norm(source_m, axis=1) / _MM, 3)
        self._prior = 1 / np.concatenate([np.tile(sizes, self.n_mics), around])

    def start(self) -> NDArray[np.float64]:
        return np.concatenate([np.zeros(self.n_of_mics), self._source_m.ravel() / _MM])

    def split(self, unknown: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return the changes of delays in µs and of positions in mm, and the sources in metres."""
        own = unknown[: self.n_of_mics].reshape(self.n_mics, self.n_own)
        moved_mm = own[:, 1:] if self.n_own == 4 else np.zeros((self.n_mics, 3))
        source_m = _MM * unknown[self.n_of_mics :].reshape(-1, 3)
        return own[:, 0], moved_mm, source_m

    def rest_s(self, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        later_us, moved_mm, source_m = self.split(unknown)
        model = travel_times(source_m, self._positions_m + _MM * moved_mm, self._speed_m_s, self._target)
        return np.asarray(self._seen.time_s - model.time_s - self._delay_s - _US * later_us)

    def residuals(self, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        rest = np.nan_to_num(self.rest_s(unknown) / _US) * self._precision_us
        return np.concatenate([rest.ravel(), (unknown - self.start()) * self._prior])

    def jacobian(self, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        _, moved_mm, source_m = self.split(unknown)
        model = travel_times(source_m, self._positions_m + _MM * moved_mm, self._speed_m_s, self._target)
        own = np.concatenate([np.ones((self.n_records, self.n_mics, 1)), model.by_microphone * (_MM / _US)], axis=2)
        slopes = np.zeros((self.n_records, self.n_mics, self.n_unknown))
        mics = np.arange(self.n_mics)
        for index in range(self.n_own):
            slopes[:, mics, mics * self.n_own + index] = -own[:, :, index]
        for record in range(self.n_records):
            first = self.n_of_mics + 3 * record
            slopes[record, :, first : first + 3] = -model.by_source[record] * (_MM / _US)
        slopes *= self._precision_us[..., None]
        return np.concatenate([slopes.reshape(-1, self.n_unknown), np.diag(self._prior)])


def fit_gains(
    seen: Observations,
    former_np: NDArray[np.float64],
    distance_m: NDArray[np.float64],
    absorption_1_m: float,
    expected: Tolerances,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fit the gains of microphones to levels.

    The level is ``ln |a| = γ + A − ln d − α d``: gain of the microphone, level of the recording, spreading and
    absorption over the distance d. The gains have a normal prior. The weights of levels that fit badly decrease
    (Cauchy). The mean change of γ is 0, because no recording can observe a common gain.

    Parameters
    ----------
    seen : Observations
    former_np : (mic,) float64
        Gains of the layout in nepers.
    distance_m : (record, mic) float64
    absorption_1_m : float
        Absorption in nepers per metre.
    expected : Tolerances

    Returns
    -------
    change_np : (mic,) float64
        Changes of the gains in nepers.
    covariance : (mic, mic) float64
        In square nepers.
    residual_np : (record, mic) float64
        NaN for values that are left out.
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
