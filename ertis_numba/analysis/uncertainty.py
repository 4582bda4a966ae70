"""Standard deviations of the positions of points."""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.air import sound_speed_m_s
from ertis_numba.analysis.noise import noise_of
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import array_weights, effective_count, microphones, unit_vectors
from ertis_numba.settings import Settings
from ertis_numba.stages.error_model import SignalModel
from ertis_numba.stages.planner import Planner
from ertis_numba.waveform import matched_noise_spectrum

__all__ = ["PositionUncertainty"]

_WAVES = 64  # Number of frequencies of the call's band from which its widths are computed.
_FLAT = 1e-12  # Relative variance of an array below which its extent counts as zero.
_UNIFORM = 0.34  # A uniform distribution has 68 % of its values within this share of its width around the middle.

# Interpolation subtracts the predicted errors of a plan. This share of their root mean square remains, because errors
# are approximated as linear over frequency, and samples are rounded. `ertis bench points` measures it.
_OF_PREDICTED = 0.02
# With spherical wavefronts, fractional delays depend on the range and are not predicted. Their errors are alike in
# neighbouring bins, so they shift a maximum by less than noise of the same power.
_OF_DELAYS, _OF_ONE_TAP = 0.1, 0.22


class _PlanError(NamedTuple):
    """Errors of a plan along the range and across, as root-mean-square noise relative to an echo."""

    along: float
    across: float


class PositionUncertainty:
    """Estimator of position errors of points, from noise, from the plan, and from a coarse grid.

    Noise contributes the Cramér-Rao bounds of a single echo in white noise

    ``σ_range = c / (4π β √(2ρ))`` and ``σ_across = r / (k √(λ 2ρ))``,

    with these quantities:

    - ρ is the power of the point relative to the mean power of the noise.
    - β is the root-mean-square width of the call's spectrum about its centre (P. M. Woodward, Probability and
      Information Theory, 1953, for the range ``cτ / 2``), and k is the root mean square of its wave numbers.
    - λ is the least variance of the microphones' positions along any direction across the line of sight (H. L. Van
      Trees, Optimum Array Processing, 2002, section 8.4). For an image of one elevation, that direction is the azimuth.
      Array weights w other than uniform replace the covariance C of the positions by ``C(w) C(w²)⁻¹ C(w)``, where the
      covariances have the weights in brackets. This expression is the inverse of the covariance of the maximum of a
      weighted beam, at the same power of noise in the image.

    The noise is estimated from medians of blocks of ranges; the median of a Rayleigh variable is √ln 2 of its root mean
    square. The estimate is the lower tercile, because side lobes of strong echoes raise the others. If echoes fill an
    image, they count as noise.

    Interpolation subtracts the predicted errors of a complete plan. A measured share of these errors remains, and the
    plan contributes it as noise. A direction that could not be interpolated, for example at the edge of a grid,
    contributes the spacing of the grid.

    A value is infinite if the array cannot resolve that direction. It is NaN if the noise is unknown: for beamformers
    other than delay-and-sum, whose noise is not Rayleigh-distributed, and if most of the image is 0, as after `clean`.
    Errors of layout, temperature and near-field curvature are not included. Interference between echoes at the same
    position is not included either.

    Parameters
    ----------
    settings : Settings
        Settings of the images; the air may differ between images.
    is_planar : bool
        True if all directions have the same elevation.
    """

    def __init__(self, settings: Settings, *, is_planar: bool) -> None:
        frequency_hz, power = matched_noise_spectrum(settings, n_waves=_WAVES)
        mean_square = float(power @ frequency_hz**2)
        positions_m = microphones(settings.array).enabled_positions_m
        self._settings, self._is_planar = settings, is_planar
        self._width_hz = math.sqrt(mean_square - float(power @ frequency_hz) ** 2)
        self._frequency_hz = math.sqrt(mean_square)
        self._covariance_m2 = _effective_covariance_m2(positions_m, array_weights(settings))

    def __call__(
        self,
        image: Energyscape,
        position_m: NDArray[np.float32],
        amplitude: NDArray[np.float32],
        resolution_rad: NDArray[np.float64],
    ) -> NDArray[np.float32]:
        """Return the standard deviations of points along the range and across, in metres.

        Parameters
        ----------
        image : Energyscape
        position_m : (point, axis) float32
            Positions in metres.
        amplitude : (point,) float32
        resolution_rad : (point,) float64
            Spacing of the directions around points whose direction is not interpolated; 0 for others.

        Returns
        -------
        (point, 2) float32
            NaN if the noise is unknown.
        """
        noise = noise_of(image) if len(amplitude) else 0.0
        if not noise:
            return np.full((len(amplitude), 2), np.nan, dtype=np.float32)
        plan = self._plan_error
        relative = noise / amplitude.astype(np.float64)
        speed_m_s = sound_speed_m_s(image.settings.air)
        along_m = speed_m_s / (4 * math.pi * self._width_hz) * np.hypot(relative, plan.along) / math.sqrt(2)
        reach_m = np.sqrt(self._min_variance_m2(position_m.astype(np.float64)))
        wave_1_m = 2 * math.pi * self._frequency_hz / speed_m_s
        range_m = np.linalg.norm(position_m, axis=1)
        across_m = np.full(len(amplitude), np.inf)
        spread_m2 = range_m * np.hypot(relative, plan.across) / math.sqrt(2) / wave_1_m
        np.divide(spread_m2, reach_m, out=across_m, where=reach_m > 0)
        across_m = np.hypot(across_m, _UNIFORM * resolution_rad * range_m)
        return np.stack([along_m, across_m], axis=1).astype(np.float32)

    @functools.cached_property
    def _plan_error(self) -> _PlanError:
        accuracy = self._settings.accuracy
        plan = (accuracy.oversampling, accuracy.delay_taps, accuracy.beam_taps)
        if self._settings.processing.method != "fast" or None in plan or accuracy.precision == "auto":
            return _PlanError(0.0, 0.0)
        echo = SignalModel.echo(self._settings, effective_count(array_weights(self._settings)))
        parts = Planner(self._settings, kernels.load("numpy"), threads=1, signal_model=echo).parts(accuracy)
        # Half of the power of an error changes a magnitude, and so does half of the power of noise.
        delays, beams = (math.sqrt(2 * parts[name]) for name in ("delays", "beams"))
        share = _OF_PREDICTED
        if self._settings.processing.wavefront == "spherical":
            share = _OF_ONE_TAP if accuracy.delay_taps == 1 else _OF_DELAYS
        return _PlanError(along=share * delays, across=math.hypot(share * delays, _OF_PREDICTED * beams))

    def _min_variance_m2(self, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the least variance of the array across the lines of sight: (point,) float64."""
        azimuth_rad = np.arctan2(position_m[:, 1], position_m[:, 0])
        level_m = np.hypot(position_m[:, 0], position_m[:, 1])
        elevation_rad = np.arctan2(position_m[:, 2], level_m)
        sideways = unit_vectors(azimuth_rad + math.pi / 2, np.zeros_like(azimuth_rad))
        aa: NDArray[np.float64] = np.einsum("pi,ij,pj->p", sideways, self._covariance_m2, sideways)
        if self._is_planar:
            return np.maximum(aa, 0.0)
        upwards = unit_vectors(azimuth_rad, elevation_rad + math.pi / 2)
        ab = np.einsum("pi,ij,pj->p", sideways, self._covariance_m2, upwards)
        bb = np.einsum("pi,ij,pj->p", upwards, self._covariance_m2, upwards)
        smallest = (aa + bb) / 2 - np.hypot((aa - bb) / 2, ab)
        # A remainder of rounding does not count as aperture.
        return np.asarray(np.where(smallest > _FLAT * (aa + bb), smallest, 0.0))


def _effective_covariance_m2(positions_m: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the position covariance of a uniform array with the same uncertainty of maxima: (axis, axis) float64."""
    if np.all(weights == 1.0):
        return np.asarray(positions_m.T @ positions_m / len(positions_m))
    offset_m = positions_m - weights @ positions_m / len(positions_m)
    signal = (offset_m.T * weights) @ offset_m / np.sum(weights)
    noise = (offset_m.T * weights**2) @ offset_m / np.sum(weights**2)
    return np.asarray(signal @ np.linalg.pinv(noise, rcond=_FLAT, hermitian=True) @ signal)
