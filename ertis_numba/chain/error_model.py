"""Error model: the image error that each step of a plan causes, predicted before processing.

Each step adds ``s ε / gain`` to the error power, where s is the share of a complex error that changes a magnitude: ½
for gain ≤ 1, and 1 − ½ / gain beyond. docs/explanation/accuracy.md has the equations.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import fourier
from ertis_numba.chain.beam_grid import Aperture, BeamGrid
from ertis_numba.chain.focal_zones import NEAREST_M
from ertis_numba.chain.interpolation_fit import WAVES, DelayFit
from ertis_numba.geometry import array_weights, effective_count
from ertis_numba.geometry.waveform import matched_band_hz, matched_filter_spectrum, matched_noise_spectrum
from ertis_numba.settings import Settings

__all__ = ["PARTS", "ErrorModel", "SignalModel", "decibels"]

PARTS: Final = {
    "delays": "interpolation of delayed samples",
    "beams": "interpolation between beam-grid points",
    "zones": "one set of delays for each focal zone",
    "samples": "16-bit samples and weights",
    "filter": "noise aliased by the decimation",
    "window": "ringing of the matched filter cut off at the time window",
    "arithmetic": "single precision",
}
"""Name and cause of the error of each step."""

_ARITHMETIC = 10 ** (-114 / 10)  # Single precision through two transforms and a sum, of any sound.
# Single precision by cause, fitted to phase shifts: real and synthetic measurements, noise, hum, and random scenes.
_OF_IMAGE = 10 ** (-137 / 10)  # Sums and output, relative to the image.
_OF_BAND = 10 ** (-136 / 10)  # Inverse transforms, which spread errors over all ranges, relative to the whole record.
_OF_SIGNALS = 10 ** (-146 / 10)  # Forward transforms, relative to the signals at all frequencies.
_OF_BAND_PCM, _OF_SIGNALS_PCM = 10 ** (-130 / 10), 10 ** (-139 / 10)  # PCM may be equal in all microphones.
_PHASE_STEP = 2 * math.pi / 2**32  # Resolution of phases in radians.
_SAFE_GAIN = 0.5  # Most of the sound comes from outside the directions of the image.
_SAFE_COLOUR = 2.0  # Echoes are strongest at the edges of the band.
_SAFE_CREST = 10 ** (17 / 10)  # A tile contains one echo.
_ECHO_CREST = 10 ** (16 / 10)  # A tile of 96 ranges contains one echo.
_SAFE_LEVEL = 10 ** (-24 / 10)  # Level in a quiet room that eRTIS was tested in.
_UNLIKE = 1.3  # Margin for differences between images: 1 dB, from the scenes of tests/chain/test_accuracy.py.
_NOISE_CORNER_HZ = 500e3  # Corner of the shaped noise of eRTIS at 4.5 MHz.
_NOISE_RATE_HZ = 4.5e6
_GUARDS = 8  # Ringing is computed over so many times the time by which a window extends beyond the image.


def decibels(power: float) -> float:
    """Return a power in decibels, ``10 log10(power)``; -300 for powers below 1e-30."""
    return 10 * math.log10(max(power, 1e-30))


@dataclass(frozen=True, slots=True, eq=False)
class SignalModel:
    """Statistics of signals after the matched filter that the error of an image depends on, besides the settings.

    - ``shares`` (wave,): distribution of the power over the frequencies of the model; the sum is 1.
    - ``gain``: mean power of the image, relative to the image of uncorrelated microphones.
    - ``crest``: largest sample power in a tile of ranges, averaged over tiles, relative to the mean sample power.
    - ``noise`` (bin,): density of recorded samples up to half the sample rate, relative to white bits.
    - ``level``: power in the ranges of the image, relative to white bits.
    - ``record_level``: power of the whole record, relative to ``level``; 0 if not measured.
    - ``loudness``: power before the matched filter, relative to ``level``; 0 if not measured.
    - ``places`` (quantile,): quantiles of the power of image points in ascending order, relative to the mean.
    - ``covariance`` (tile, wave, mic, mic): of signals of some microphones, at the frequencies of a `BeamGrid`.
    - ``colour``: margin on interpolation errors computed from ``shares``; 1 if ``shares`` was measured.
    """

    shares: NDArray[np.float64]
    gain: float
    crest: float
    noise: NDArray[np.float64]
    level: float
    places: NDArray[np.float64]
    covariance: NDArray[np.complex128] | None = None
    colour: float = 1.0
    loudness: float = 0.0
    record_level: float = 0.0

    @classmethod
    def unknown(cls, settings: Settings) -> "SignalModel":
        """Return the safe signal model that is assumed without a measurement."""
        _, shares = matched_noise_spectrum(settings, n_waves=WAVES)
        if not settings.recording.is_pdm:  # There may be as much sound outside the band as inside.
            return cls(shares, _SAFE_GAIN, _SAFE_CREST, np.ones(2), 1.0, np.ones(1), colour=_SAFE_COLOUR)
        frequency_hz = np.linspace(0, settings.recording.sample_rate_hz / 2, 1025)
        corner_hz = _NOISE_CORNER_HZ * settings.recording.sample_rate_hz / _NOISE_RATE_HZ
        noise = np.minimum(1.0, (frequency_hz / corner_hz) ** 4)
        return cls(shares, _SAFE_GAIN, _SAFE_CREST, noise, _SAFE_LEVEL, np.ones(1), colour=_SAFE_COLOUR)

    @classmethod
    def echo(cls, settings: Settings, n_mics: float) -> "SignalModel":
        """Return the signal model of a single echo that all microphones receive in phase."""
        _, shares = matched_noise_spectrum(settings, n_waves=WAVES)
        power = shares**2  # The spectrum of the echo times that of the filter.
        return cls(power / power.sum(), float(n_mics), _ECHO_CREST, np.ones(2), 1.0, np.ones(1))


class ErrorModel:
    """Predictor of the error power of each step, relative to the exact image; safe without a signal model."""

    def __init__(self, settings: Settings, signal_model: SignalModel | None = None) -> None:
        self._settings = settings
        self.signal_model = signal_model or SignalModel.unknown(settings)
        self.frequency_hz, _ = matched_noise_spectrum(settings, n_waves=WAVES)
        self._weights = array_weights(settings)

    def delays(
        self,
        fit: DelayFit,
        *,
        n_mics: float,
        fractions: NDArray[np.float64] | None = None,
        passed: NDArray[np.float64] | None = None,
    ) -> float:
        """Return the error power of delay interpolation: the residual of the fit, weighted by the signal spectrum."""
        # The mean error over all delays acts as a filter; the rest averages out less among few microphones, `n_mics`.
        signal_model = self.signal_model
        if fractions is not None:
            return (
                signal_model.colour
                * float(fit.errors_at(fractions) @ signal_model.shares)
                * max(1.0, 0.5 / signal_model.gain)
            )
        errors = fit.errors if passed is None else fit.errors * passed
        varying = float(errors @ signal_model.shares)
        independent = 0.5 * (1 + 1 / n_mics) * varying / signal_model.gain
        return signal_model.colour * independent + self.shared_delays(fit)

    def late(self, variance_s2: float) -> float:
        """Return the error power of delays whose errors have this variance over microphones, in s²."""
        turn_2 = (2 * math.pi * self.frequency_hz) ** 2 @ self.signal_model.shares
        return self._of(float(turn_2) * variance_s2)

    def shared_delays(self, fit: DelayFit) -> float:
        """Return the error power of delays that all microphones share, as part of `delays`."""
        return 0.5 * self.signal_model.colour * float(fit.biases @ self.signal_model.shares)

    @property
    def needs_steering(self) -> bool:
        """True if the error of plane-wave beams depends on a measured covariance."""
        return self.signal_model.covariance is not None

    def uniform_beams(self, errors: NDArray[np.float64]) -> float:
        """Return the error power of beam interpolation without a covariance, from the errors at each frequency."""
        return self._of(_UNLIKE * self.signal_model.colour * float(errors @ self.signal_model.shares))

    def beams(self, nodes: BeamGrid) -> float:
        """Return the error power of beam interpolation, from an estimate of `BeamGrid`.

        Without a measured covariance, the signal spectrum weights the errors, as in `delays`. With a covariance R, the
        beam ``b = hᵀx`` and its error ``e = dᵀx`` are sums of the same signals x in each tile. The error power of the
        envelope is ``Re(C_eb)² / C_bb + ½ (C_ee − |C_eb|² / C_bb)``, with ``C_eb = dᵀ R h*``, and likewise C_bb and
        C_ee.
        """
        covariance = self.signal_model.covariance
        if covariance is None or nodes.is_curved:
            return self.uniform_beams(nodes.errors)
        n_tiles, n_waves, _, _ = covariance.shape
        n_directions = nodes.steering.shape[2]
        beams, errors = np.zeros((2, n_tiles, n_directions))
        both = np.zeros((n_tiles, n_directions), dtype=np.complex128)
        for wave in range(n_waves):  # One frequency at a time keeps all arrays in the cache.
            steering, missed = nodes.steering[:, wave], nodes.wrong[:, wave]
            sums = covariance[:, wave] @ np.conj(np.concatenate([steering, missed], axis=1))
            heard, lost = sums[:, :, :n_directions], sums[:, :, n_directions:]
            beams += np.sum(steering * heard, axis=1).real
            both += np.sum(missed * heard, axis=1)
            errors += np.sum(missed * lost, axis=1).real
        beams = np.maximum(beams, 1e-9 * beams.max(initial=1e-30))
        wrong = both.real**2 / beams + 0.5 * np.maximum(errors - np.abs(both) ** 2 / beams, 0.0)
        return _UNLIKE * float(wrong.sum() / beams.sum())

    def zones(self, aperture: Aperture, curvature_2: float, *, sound_speed_m_s: float) -> float:
        """Return the error power of focal zones whose curvatures deviate by this mean square, in 1/m²."""
        along_m = aperture.directions @ aperture.positions_m.T
        across_m2 = np.maximum(aperture.square_m2 - along_m**2, 0.0)
        weights, power = self._weights, self._weights**2 / np.mean(self._weights**2)
        middle_m2 = np.mean(weights * across_m2, axis=1)
        spread_m4 = float(np.mean(np.mean(power * (across_m2 - middle_m2[:, None]) ** 2, axis=1)))
        turn_2 = (2 * math.pi * self.frequency_hz / (2 * sound_speed_m_s)) ** 2 * spread_m4
        shares = self.signal_model.shares
        centre_hz = float(self.frequency_hz @ shares)
        shared_m4 = float(np.mean(middle_m2**2))
        shift_2 = (2 * math.pi * (self.frequency_hz - centre_hz) / (2 * sound_speed_m_s)) ** 2 * shared_m4
        return self._of(float(turn_2 @ shares) * curvature_2) + float(shift_2 @ shares) * curvature_2

    def plane_waves(self, aperture: Aperture, range_m: float, *, sound_speed_m_s: float) -> float:
        """Return the error power of plane wavefronts relative to spherical ones at one range, at most 1."""
        return min(1.0, self.zones(aperture, max(range_m, NEAREST_M) ** -2, sound_speed_m_s=sound_speed_m_s))

    def samples(self, *, n_terms: int, terms: float, limit: float, weight_limit: float, taps: float) -> float:
        """Return the error power of rounding real and imaginary parts of samples and weights by up to half a step."""
        of_samples = terms * self.signal_model.crest / limit**2 / 6
        of_weights = n_terms / weight_limit**2 / 6
        return self._of(taps * (of_samples + of_weights))

    def nodes(self, *, n_mics: int, sum_of_terms: float, taps: float, filled: float) -> float:
        """Return the error power of rounding beams at grid points to 16 bits, steps of 2⁻¹⁵ of all terms at full scale.

        ``sum_of_terms`` is the sum of the magnitudes of a microphone's weights, and ``filled`` that of all terms / 2³¹.
        """
        step_2 = self.signal_model.crest * n_mics * (sum_of_terms / filled) ** 2 / 2.0**30
        return self._of(taps * step_2 / 6)

    def filter(self, taps: NDArray[np.int16] | NDArray[np.int32]) -> float:
        """Return the error power of noise that the decimation aliases into the band through the filter's stopband."""
        settings = self._settings
        low_hz, high_hz = matched_band_hz(settings)
        frequency_hz, folded = self._filtered_noise(taps)
        rate_hz = settings.signal_rate_hz
        distance_hz = np.abs(frequency_hz - rate_hz * np.rint(frequency_hz / rate_hz))
        outside = (frequency_hz > rate_hz / 2) & (distance_hz > low_hz) & (distance_hz < high_hz)
        passed = float(folded[outside].sum()) * (frequency_hz[1] - frequency_hz[0]) / (high_hz - low_hz)
        return self._everywhere(_UNLIKE * passed / self.signal_model.level)

    def window(self, taps: NDArray[np.int16] | NDArray[np.int32], *, guard_s: float, imaged_s: float) -> float:
        """Return the error power of ringing beyond a time window: it is cut off at each end, and as much wraps around.

        The cut of the ringing falls with the sixth power of the time inside the window.
        """
        settings, model = self._settings, self.signal_model
        rate_hz, call_s = settings.signal_rate_hz, settings.call.end_s
        n_fft = fourier.next_fast_len(math.ceil((2 * call_s + _GUARDS * guard_s) * rate_hz))
        matched = matched_filter_spectrum(settings, n_fft=n_fft)
        spectrum = np.zeros(n_fft, dtype=np.complex128)
        spectrum[matched.first_bin : matched.first_bin + len(matched.values)] = matched.values
        response = fourier.ifft(spectrum)
        time_s = np.fft.fftfreq(n_fft, 1 / n_fft) / rate_hz
        response[(time_s <= guard_s) & (time_s >= -call_s - guard_s)] = 0
        noise_hz, noise = self._filtered_noise(taps)
        heard = np.interp(np.abs(np.fft.fftfreq(n_fft, 1 / rate_hz)), noise_hz, noise)
        missed = float(np.abs(fourier.fft(response)) ** 2 @ heard) / float(np.sum(np.abs(matched.values) ** 2))
        inside = imaged_s / guard_s
        mean = (1 - (1 + inside) ** -5) / (5 * inside) if inside else 1.0
        return self._everywhere(2 * mean * missed / model.level)

    def _filtered_noise(
        self, taps: NDArray[np.int16] | NDArray[np.int32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the power density of the noise after the decimation filter, relative to white bits, by frequency."""
        noise = self.signal_model.noise
        n_fft = 2 * (len(noise) - 1)
        n_fft *= max(1, -(-8 * len(taps) // n_fft))  # The bins resolve the side lobes of the filter.
        gain_2 = np.abs(np.fft.rfft(taps / taps.sum(dtype=np.int64), n_fft)) ** 2
        frequency_hz = np.arange(len(gain_2)) * self._settings.recording.sample_rate_hz / n_fft
        return frequency_hz, gain_2 * np.interp(frequency_hz, np.linspace(0, frequency_hz[-1], len(noise)), noise)

    def _everywhere(self, power: float) -> float:
        """Return the error power of independent noise in the whole image, from its power relative to the signals."""
        power /= self.signal_model.gain
        # The exponential approximates the mean of a Rice distribution.
        dark = np.exp(-4 * np.sqrt(self.signal_model.places / max(power, 1e-30)))
        return float(power * (0.5 + 0.5 * np.mean(dark)))

    def arithmetic(self) -> float:
        """Return the error power of single precision."""
        # PCM microphones may round loud sound outside the window alike; the noise of PDM bits prevents this.
        model = self.signal_model
        if not self._settings.recording.is_pdm:
            alike = effective_count(self._weights)
            of_signals = _ARITHMETIC + _OF_SIGNALS_PCM * model.loudness
            return of_signals / model.gain + alike * _OF_BAND_PCM * model.record_level
        if not model.record_level:  # not measured
            return _ARITHMETIC / model.gain
        return (_OF_IMAGE + _OF_SIGNALS * model.loudness) / model.gain + _OF_BAND * model.record_level

    def phases(self, n_bins: int) -> float:
        """Return the error power of rounding phase steps to 2⁻³² of a turn, which adds up to the edges of the band."""
        return self._of(_PHASE_STEP**2 * n_bins**2 / 144)

    def _of(self, power: float) -> float:
        gain = self.signal_model.gain
        return (0.5 if gain <= 1 else 1 - 0.5 / gain) * power / gain
