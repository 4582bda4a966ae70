"""Standard deviations of the positions of points."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.peak_interpolation import Tops
from ertis_numba.analysis.plan_errors import plan_error
from ertis_numba.analysis.point_spread import PointSpread, spread_of
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import array_weights, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import matched_noise_spectrum
from ertis_numba.settings import Settings

__all__ = ["PositionUncertainty", "Uncertainty", "listed_echoes", "unlisted_echoes"]

_WAVES = 64  # Number of frequencies of the call's band from which its widths are computed.
# Errors of a maximum that is two echoes, relative to the widths of pulse and main lobe, and to the root of the misfit.
_CLOSE_M, _CLOSE_RAD = 0.7, 1.7
_CLOSE_NP, _MOST_NP = 1.25, 0.25  # Error of its level, and its limit.
_SEEN = 0.45  # Misfit that other points cause, relative to their amplitude at the maximum.
# Bias of the range in widths of the pulse, relative to the error of the plan: it is alike in all bins. Measured.
_BIAS, _BIAS_OF_ONE_TAP, _BIAS_OF_FOUR_BEAM_TAPS = 2.0, 1.0, 9.0
_HALF = math.sqrt(0.5)  # Half of the power of a disturbance changes the amplitude, half the phase.
_UNSEEN = 3e-4  # Relative amplitude of side lobes of the call of other echoes, which no image shows.
_FLAT = 1e-12  # Relative variance of an array below which its extent counts as zero.
_UNIFORM = 0.34  # A uniform distribution has 68 % of its values within this share of its width around the middle.


_LOBE: Final = 10 ** (3.0 / 20) - 1  # Error of a predicted side lobe relative to it, as of `SideLobes`.
_SLOPE: Final = 0.05  # The same of the pulse along the range.
_NOISE: Final = 3.0  # Amplitude relative to the noise, below which nothing is seen.
_PLAN: Final = 0.5  # Error of the slopes relative to the error budget.
_PHASE: Final = 1.5  # Amplitude of an echo relative to the change that it causes.
_BESIDE: Final = 1.5  # First offset along the range in steps; the fit of a point includes nearer ones.
_SMEARED: Final = 2.0  # Images of other points along the range relative to their pulse.
Floats = NDArray[np.float64]


class Uncertainty(NamedTuple):
    """Standard deviations of points (point,): along the range, across it on the least certain axis, level in nepers."""

    range_m: NDArray[np.float64]
    across_rad: NDArray[np.float64]
    level: NDArray[np.float64]


class PositionUncertainty:
    """Estimator of the errors of points, from noise, from the plan, and from the grid.

    `ertis_numba.analysis.echo_fits.EchoFits` states the errors of fitted echoes, see docs/explanation/accuracy.md. With
    ``noise_only``, errors are the Cramér-Rao bounds of a single echo in white noise, ``σ_range = c / (4π β √(2ρ))``,
    ``σ_across = r / (k √(λ 2ρ))`` and ``σ_level = 1 / √(2ρ)`` nepers. ρ is the power of the point relative to the
    noise, β the RMS width of the call's spectrum, k the RMS wave number, and λ the least variance of the microphones'
    positions across the line of sight, of ``C(w) C(w²)⁻¹ C(w)`` with array weights w (P. M. Woodward, 1953; H. L. Van
    Trees, Optimum Array Processing, 2002, section 8.4). A value is infinite if the array cannot resolve that direction,
    and NaN if the noise is unknown or the method is ``paper``.
    """

    def __init__(self, settings: Settings, *, is_planar: bool, noise_only: bool = False) -> None:
        frequency_hz, power = matched_noise_spectrum(settings, n_waves=_WAVES)
        mean_square = float(power @ frequency_hz**2)
        positions_m = microphones(settings.array).enabled_positions_m
        self._settings, self._is_planar, self._noise_only = settings, is_planar, noise_only
        self._width_hz = math.sqrt(mean_square - float(power @ frequency_hz) ** 2)
        self._frequency_hz = math.sqrt(mean_square)
        self._spread = spread_of(settings, path_m=sum(settings.processing.range_m))
        self._plan = 0.0 if noise_only else plan_error(settings)
        bias = _BIAS_OF_ONE_TAP if settings.accuracy.delay_taps == 1 else _BIAS
        self._bias = self._plan * (_BIAS_OF_FOUR_BEAM_TAPS if settings.accuracy.beam_taps == 4 else bias)
        recording = settings.recording
        self._clock_s = 1 / recording.sample_rate_hz if recording.is_pdm else 0.0  # Bits tell no time within it.
        self._covariance_m2 = _effective_covariance_m2(positions_m, array_weights(settings))

    def __call__(self, image: Energyscape, tops: Tops, *, noise: float) -> Uncertainty:
        """Return the standard deviations of points; NaN if ``noise`` is 0. Widths of π or ∞ are unknown directions."""
        is_paper = self._settings.processing.method == "paper" and not self._noise_only
        if not noise or is_paper:
            unknown = np.full(len(tops.range_m), np.nan)
            return Uncertainty(unknown, unknown, unknown)
        relative = noise / tops.amplitude / math.sqrt(2)
        speed_m_s = sound_speed_m_s(image.settings.air)
        pulse_m = speed_m_s / (4 * math.pi * self._width_hz)
        reach_m = np.sqrt(self._min_variance_m2(tops.direction))
        lobe_rad = np.full(len(relative), np.inf)
        np.divide(speed_m_s / (2 * math.pi * self._frequency_hz), reach_m, out=lobe_rad, where=reach_m > 0)
        range_m, across_rad, level = pulse_m * relative, lobe_rad * relative, relative
        if not self._noise_only:
            is_fitted = np.isfinite(tops.across_sd_rad)
            range_m = np.where(is_fitted, tops.range_sd_m, range_m)
            clock_m = _UNIFORM * self._clock_s * speed_m_s / 2
            range_m = np.hypot(np.hypot(range_m, self._bias * pulse_m), clock_m)
            level = np.hypot(np.where(is_fitted, tops.level_sd, level), self._plan)
            across_rad = np.where(is_fitted & (reach_m > 0), tops.across_sd_rad, across_rad)
            others = listed_echoes(self._spread, image, tops, noise)
            unseen = np.sqrt((tops.misfit**2 - (_SEEN * others) ** 2).clip(0.0, 1.0))
            others = np.hypot(others, unlisted_echoes(self._spread, image, tops, noise))
            range_m = np.hypot(range_m, pulse_m * np.hypot(_HALF * others, _CLOSE_M * np.sqrt(unseen)))
            wrong = np.maximum(np.hypot(_HALF * others, _CLOSE_RAD * np.sqrt(unseen)), _FLAT)
            if len(tops.range_m) > 1:
                wrong = np.hypot(wrong, _UNSEEN)
            across_rad = np.hypot(across_rad, lobe_rad * wrong)
            level = np.hypot(level, np.hypot(_HALF * others, np.minimum(_CLOSE_NP * np.sqrt(unseen), _MOST_NP)))
        return Uncertainty(range_m, np.hypot(across_rad, _UNIFORM * tops.width_rad), level)

    def _min_variance_m2(self, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the least variance of the array across the lines of sight: (point,) float64."""
        azimuth_rad = np.arctan2(position_m[:, 1], position_m[:, 0])
        level_m = np.hypot(position_m[:, 0], position_m[:, 1])
        elevation_rad = np.arctan2(position_m[:, 2], level_m)
        sideways = unit_vectors(azimuth_rad + math.pi / 2, np.zeros_like(azimuth_rad))
        aa: NDArray[np.float64] = np.einsum("pi,ij,pj->p", sideways, self._covariance_m2, sideways)
        if self._is_planar:
            return np.asarray(np.where(aa > _FLAT * np.trace(self._covariance_m2), aa, 0.0))
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


def listed_echoes(spread: PointSpread, image: Energyscape, tops: Tops, noise: float) -> Floats:
    """Return the amplitude of other points' images at each point, relative to its own: (point,) float64."""
    leak = _leak(spread, image, tops)
    echoes = np.zeros(len(leak))
    for point in np.argsort(-tops.amplitude, kind="stable"):
        lobes, amplitude = leak[point] * echoes, float(tops.amplitude[point])
        strongest = lobes.max()
        doubt = _LOBE * strongest + math.sqrt(max(float(lobes @ lobes) - strongest**2, 0.0)) + noise
        low, high = max(strongest - doubt, 0.0), strongest + doubt
        own = max(amplitude**2 - high**2, low**2 - amplitude**2, 0.0)
        echoes[point] = math.sqrt(own) if strongest > 0 else amplitude
    return np.asarray(np.linalg.norm(leak * echoes, axis=1) / tops.amplitude)


def unlisted_echoes(spread: PointSpread, image: Energyscape, tops: Tops, noise: float) -> Floats:
    """Return the amplitude of echoes within the slopes of points, relative to these: (point,) float64."""
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    found, reach_m = np.zeros(len(tops.range_m)), spread.skirt_m
    if len(image.range_m) < 2:
        return found
    step_m, scale = float(image.range_m[1] - image.range_m[0]), spread.scale(image.settings.air)
    plan = _PLAN * 10 ** (image.settings.accuracy.max_error_db / 20)
    tilt_s, _ = spread.tilts(tops.range_m, image.settings.air)
    across = _leak(spread, image, tops, is_across=True) * tops.amplitude
    for point, range_m in enumerate(tops.range_m):
        first, last = np.searchsorted(image.range_m, [range_m - reach_m, range_m + reach_m])
        if first == last:  # The ranges are farther apart than a pulse is long.
            continue
        nearest = int(np.argmax(directions @ tops.direction[point]))
        row = image.amplitude[nearest, first:last].astype(np.float64)
        offset_m = image.range_m[first:last] - range_m
        pulse, middle = spread.along(scale * offset_m, tilt_s[point]), int(np.abs(offset_m).argmin())
        aside = np.tile(directions[nearest] - tops.direction[point], (len(row), 1))
        untilted = np.maximum(spread.along(scale * offset_m, 0.0), pulse / 2)  # Zeros of a pulse are no reference.
        image_there = spread(aside, offset_m, image.settings.air) * pulse / untilted
        own = row[middle] / max(image_there[middle], _SLOPE) * image_there
        near = np.flatnonzero(across[point])
        away_m = offset_m - (tops.range_m[near] - range_m)[:, None]
        others = across[point, near] @ spread.along(scale * away_m, 0.0)
        doubt = _SLOPE * own + _SMEARED * others + _NOISE * noise + plan * own[middle]
        rest = np.where(np.abs(offset_m) > _BESIDE * step_m, (row - own) ** 2 - doubt**2, 0.0)
        found[point] = _PHASE * math.sqrt(max(float((rest * pulse**2).max()), 0.0)) / tops.amplitude[point]
    return found


def _leak(spread: PointSpread, image: Energyscape, tops: Tops, *, is_across: bool = False) -> Floats:
    """Return the amplitude of each point's image at each other, or at its direction and their own range."""
    is_near = np.abs(tops.range_m - tops.range_m[:, None]) < spread.valid_m
    np.fill_diagonal(is_near, val=False)
    here, there = np.nonzero(is_near)
    offset, offset_m = tops.direction[here] - tops.direction[there], tops.range_m[here] - tops.range_m[there]
    leak = np.zeros(is_near.shape)
    leak[here, there] = spread(offset, np.zeros(len(here)) if is_across else offset_m, image.settings.air)
    return leak
