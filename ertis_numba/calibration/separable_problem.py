"""Least-squares problem of times of arrival, in which each microphone is solved by itself for given sources."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.calibration.observations import Observations, Tolerances
from ertis_numba.calibration.wavefronts import Target, TravelTimes, travel_times

__all__ = ["MM", "US", "SeparableProblem", "Solution"]

US: Final = 1e-6
MM: Final = 1e-3
"""The unknowns are in microseconds and millimetres, so that their sizes are alike."""
_INNER_ROUNDS: Final = 3  # Travel times are almost linear in the positions of microphones.


class Solution(NamedTuple):
    """Microphones and sources."""

    own: NDArray[np.float64]  # (mic, quantity): change of the delay in µs, then of x, y and z in mm if fitted
    source_m: NDArray[np.float64]  # (record, axis)
    residual_s: NDArray[np.float64]  # (record, mic), measured minus fitted


class SeparableProblem:
    """Residuals and Jacobian as functions of the sources alone.

    Delay and position of each microphone follow from the sources by linear least squares: variable projection (G. H.
    Golub and V. Pereyra, 1973). The Jacobian omits the derivative of the projection (L. Kaufman, 1975).
    """

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
        self._start_mm = source_m.ravel() / MM
        self._speed_m_s, self._target = speed_m_s, target
        self.n_records, self.n_mics = seen.time_s.shape
        self.n_own = 4 if expected.position_m > 0 else 1
        self._precision_us = np.where(np.isfinite(seen.time_sd_s), US / seen.time_sd_s, 0.0)
        self._weight = np.ones((self.n_records, self.n_mics))
        self._prior = 1 / np.array([expected.delay_s / US, *(3 * [expected.position_m / MM])][: self.n_own])
        # A line of microphones does not determine the angle around it, so sources have a prior, though a weak one.
        self._source_prior = 1 / np.repeat(np.linalg.norm(source_m, axis=1) / MM, 3)
        self._own = np.zeros((self.n_mics, self.n_own))

    @property
    def start_mm(self) -> NDArray[np.float64]:
        """First approximation of the sources in mm: (3 record,) float64."""
        return self._start_mm

    def reweigh(self, weight: NDArray[np.float64]) -> None:
        """Set factors of the precision of each time: (record, mic) float64."""
        self._weight = weight

    def residuals(self, source_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the residuals of each microphone's times and priors, then those of the sources' priors."""
        own = self._solved(source_mm)
        rest = self._rest_us(own, source_mm) * self._precision
        of_mics = np.concatenate([rest.T, own * self._prior], axis=1)
        return np.append(of_mics.ravel(), (source_mm - self._start_mm) * self._source_prior)

    def jacobian(self, source_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of the residuals by the sources: (residual, 3 record) float64."""
        projected, *_ = self._projected(self._solved(source_mm), source_mm)
        return np.concatenate([projected.reshape(-1, 3 * self.n_records), np.diag(self._source_prior)])

    def solution(self, source_mm: NDArray[np.float64]) -> Solution:
        """Return the microphones and sources for the solution of the remaining problem."""
        own = self._solved(source_mm)
        rest_s = US * self._rest_us(own, source_mm)
        return Solution(own, MM * source_mm.reshape(-1, 3), np.where(self._precision_us > 0, rest_s, np.nan))

    def covariance(self, source_mm: NDArray[np.float64], factor: float) -> tuple[NDArray[np.float64], float]:
        """Return the covariance (mic, quantity, mic, quantity) and the number of determined unknowns."""
        # It follows from the Schur complement of the sources; `factor` is the variance relative to the expected one.
        projected, inverse, gain = self._projected(self._solved(source_mm), source_mm, factor)
        rows = projected.reshape(-1, 3 * self.n_records)
        of_sources = np.linalg.inv(rows.T @ rows + np.diag(self._source_prior**2))
        flat = gain.reshape(-1, 3 * self.n_records)
        size = self.n_mics, self.n_own
        covariance = (flat @ of_sources @ flat.T).reshape(*size, *size)
        mics = np.arange(self.n_mics)
        covariance[mics, :, mics, :] += inverse
        variances = np.einsum("mimi->mi", covariance)
        by_priors = float(np.sum(variances * self._prior**2) + np.diag(of_sources) @ self._source_prior**2)
        return covariance, self.n_mics * self.n_own + 3 * self.n_records - by_priors

    @property
    def _precision(self) -> NDArray[np.float64]:
        return self._precision_us * self._weight

    def _model(self, own: NDArray[np.float64], source_mm: NDArray[np.float64]) -> TravelTimes:
        moved_m = MM * own[:, 1:] if self.n_own > 1 else 0.0
        return travel_times(MM * source_mm.reshape(-1, 3), self._positions_m + moved_m, self._speed_m_s, self._target)

    def _rest_us(self, own: NDArray[np.float64], source_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the measured minus the expected times, 0 for values that are left out: (record, mic) float64."""
        rest_us = (self._seen.time_s - self._model(own, source_mm).time_s - self._delay_s) / US - own[:, 0]
        return np.where(self._precision_us > 0, rest_us, 0.0)

    def _slopes(self, own: NDArray[np.float64], source_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of each microphone's residuals by its own unknowns: (mic, row, quantity) float64."""
        model = self._model(own, source_mm)
        by_own = np.concatenate([np.ones((self.n_records, self.n_mics, 1)), model.by_microphone * (MM / US)], axis=2)
        times = -(by_own[..., : self.n_own] * self._precision[..., None]).transpose(1, 0, 2)
        priors = np.broadcast_to(np.diag(self._prior), (self.n_mics, self.n_own, self.n_own))
        return np.concatenate([times, priors], axis=1)

    def _solved(self, source_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unknowns of all microphones for given sources: (mic, quantity) float64."""
        own = self._own
        for _ in range(_INNER_ROUNDS):
            slopes = self._slopes(own, source_mm)
            rest = np.concatenate([(self._rest_us(own, source_mm) * self._precision).T, own * self._prior], axis=1)
            normal = np.einsum("mki,mkj->mij", slopes, slopes)
            own = own - np.linalg.solve(normal, np.einsum("mki,mk->mi", slopes, rest)[..., None])[..., 0]
        self._own = own
        return own

    def _projected(
        self, own: NDArray[np.float64], source_mm: NDArray[np.float64], factor: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return projected derivatives by the sources, and two parts of the covariance.

        The derivatives are (mic, row, 3 record). The covariance of each microphone for known sources is (mic, quantity,
        quantity); its change by changes of the sources, with a negative sign, is (mic, quantity, 3 record).
        """
        scale = 1 / np.sqrt(factor)
        slopes = self._slopes(own, source_mm)
        slopes[:, : self.n_records] *= scale
        by_source = -self._model(own, source_mm).by_source * (MM / US) * (scale * self._precision)[..., None]
        inverse = np.linalg.inv(np.einsum("mki,mkj->mij", slopes, slopes))
        records = np.arange(self.n_records)
        crossed = np.einsum("mki,kma->mika", slopes[:, : self.n_records], by_source)
        gain = np.einsum("mij,mjka->mika", inverse, crossed).reshape(self.n_mics, self.n_own, -1)
        projected = -slopes @ gain
        blocks = projected.reshape(self.n_mics, -1, self.n_records, 3)
        blocks[:, records, records] += by_source.transpose(1, 0, 2)
        return blocks.reshape(self.n_mics, -1, 3 * self.n_records), inverse, gain
