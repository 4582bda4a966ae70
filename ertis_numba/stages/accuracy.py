"""By how much an image differs from the exact one: what each choice of a plan adds, before it is made.

The error is ``‖image − exact‖ / ‖exact‖`` over all directions and ranges, in decibels. The exact image is that of
`tests/reference.py`: float64, nothing decimated, delays as exact phase shifts.

Most parts are errors of complex beams that add up like noise: between microphones, because `fitting` leaves hardly any
error that they share, and between parts. A part whose power is ε of that of a microphone's signal after the matched
filter therefore adds, to an image whose mean power is ``gain`` times that of uncorrelated microphones,

    s ε / gain ,   s = ½ for gain ≤ 1,   s = 1 − ½ / gain beyond.

s is the share of a complex error that changes a magnitude: half of it in noise, where the other half turns the phase,
which the envelope does not see; more where few coherent echoes make most of the image, since beam and error are then
sums of the same waves and tend to have one phase. How much brighter coherent echoes make the image is what settings
cannot tell; a `SignalModel` measures it, and where there is none the model assumes what errs on the safe side.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import array_weights, effective_count
from ertis_numba.settings import Settings
from ertis_numba.stages.beam_grid import Aperture, BeamNodes
from ertis_numba.stages.fitting import WAVES, DelayFit
from ertis_numba.stages.focal_zones import NEAREST_M
from ertis_numba.waveform import matched_band_hz, matched_noise_spectrum

__all__ = ["PARTS", "ErrorModel", "SignalModel", "decibels"]

PARTS: Final = {
    "delays": "interpolation of delayed samples",
    "beams": "interpolation of beams between nodes",
    "zones": "one set of delays for all ranges of a zone",
    "samples": "16-bit samples and weights",
    "filter": "noise that the decimation lets through",
    "arithmetic": "single precision",
}
"""Name of each part of the error, and what it is due to."""

_ARITHMETIC = 10 ** (-114 / 10)  # single precision through two transforms and a sum: measured -116 to -130 dB
_ROUNDING = 10 ** (-114 / 10)  # single precision, relative to all that is transformed: -115 to -140 dB measured
_SAFE_GAIN = 0.5  # most of the sound comes from where nobody looks
_SAFE_COLOUR = 2.0  # echoes are strongest at the edges of the band
_SAFE_CREST = 10 ** (17 / 10)  # one echo in a tile
_ECHO_CREST = 10 ** (16 / 10)  # one echo in a tile of 96 ranges
_SAFE_LEVEL = 10 ** (-24 / 10)  # as quiet as a room that eRTIS was tried in
_UNLIKE = 1.3  # for what differs between images: 1 dB, found over the scenes of tests/test_accuracy.py
_NOISE_CORNER_HZ = 500e3  # of the shaped noise of eRTIS at 4.5 MHz
_NOISE_RATE_HZ = 4.5e6


def decibels(power: float) -> float:
    """Return ``10 log10``, -300 for nothing at all."""
    return 10 * math.log10(max(power, 1e-30))


@dataclass(frozen=True, slots=True, eq=False)
class SignalModel:
    """What the error depends on besides the settings: a few numbers of what is heard.

    Attributes
    ----------
    shares : (wave,) float64
        Of the power after the matched filter, at the frequencies of the model; they add up to 1.
    gain : float
        Mean power of the image by what it would be of microphones that have nothing in common.
    crest : float
        Largest power of any sample of a tile of ranges, the mean over tiles, by the mean power of samples.
    noise : (bin,) float64
        Power density of the words from 0 to half their rate, by that of white bits.
    level : float
        Power after the matched filter, in the ranges of the image, by that of white bits.
    places : (quantile,) float64
        Power of the image at its places, from the darkest to the brightest, by the mean.
    covariance : (tile, wave, mic, mic) complex128, optional
        Of what some microphones hear in each tile of ranges, at the frequencies of an estimate of `BeamNodes`.
    colour : float
        By how much more interpolation errs than ``shares`` let expect; 1 where they were measured.
    loudness : float
        Power of the signals before the matched filter, over all times and frequencies, relative to ``level``. Both are
        relative to white bits. It is 0 if it was not measured.
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

    @classmethod
    def unknown(cls, settings: Settings) -> "SignalModel":
        """Return the texture that is assumed where none was measured: on the safe side."""
        _, shares = matched_noise_spectrum(settings, n_waves=WAVES)
        if not settings.recording.is_pdm:  # beyond the band there may be as much sound as within
            return cls(shares, _SAFE_GAIN, _SAFE_CREST, np.ones(2), 1.0, np.ones(1), colour=_SAFE_COLOUR)
        frequency_hz = np.linspace(0, settings.recording.sample_rate_hz / 2, 1025)
        corner_hz = _NOISE_CORNER_HZ * settings.recording.sample_rate_hz / _NOISE_RATE_HZ
        noise = np.minimum(1.0, (frequency_hz / corner_hz) ** 4)
        return cls(shares, _SAFE_GAIN, _SAFE_CREST, noise, _SAFE_LEVEL, np.ones(1), colour=_SAFE_COLOUR)

    @classmethod
    def echo(cls, settings: Settings, n_mics: float) -> "SignalModel":
        """Return the texture of a single echo, to which all microphones contribute in phase."""
        _, shares = matched_noise_spectrum(settings, n_waves=WAVES)
        power = shares**2  # that of the echo, beside that of the filter
        return cls(power / power.sum(), float(n_mics), _ECHO_CREST, np.ones(2), 1.0, np.ones(1))


class ErrorModel:
    """The parts of an image's error, each as power by that of the exact image.

    Parameters
    ----------
    settings : Settings
    signal_model : Texture, optional
        Measured; what errs on the safe side by default.
    """

    def __init__(self, settings: Settings, signal_model: SignalModel | None = None) -> None:
        self._settings = settings
        self.signal_model = signal_model or SignalModel.unknown(settings)
        self.frequency_hz, _ = matched_noise_spectrum(settings, n_waves=WAVES)
        self._weights = array_weights(settings)

    def delays(self, fit: DelayFit, *, n_mics: float, fractions: NDArray[np.float64] | None = None) -> float:
        """Return the part of interpolated delays: what the fit leaves at each frequency, weighted by what is heard.

        What samples are wrong by on average is a filter of the image itself, however coherent echoes are; the
        simple ways of interpolation weaken it, which changes magnitudes by all of it. Of the rest no two
        microphones err alike, so that it has no phase in common with the beam. Few microphones average less: the error
        of a single one is a filter of its own signal.

        Parameters
        ----------
        fit : DelayFit
        n_mics : float
            Effective number of microphones: see `ertis_numba.geometry.effective_count`.
        fractions : (delay,) float64, optional
            Fractions of a step in the delays, if the delays are too few to spread evenly.
        """
        signal_model = self.signal_model
        if fractions is not None:
            return (
                signal_model.colour
                * float(fit.errors_at(fractions) @ signal_model.shares)
                * max(1.0, 0.5 / signal_model.gain)
            )
        varying, shared = (float(errors @ signal_model.shares) for errors in (fit.errors, fit.biases))
        independent = 0.5 * (1 + 1 / n_mics) * varying / signal_model.gain
        return signal_model.colour * (independent + (0.5 if fit.is_fitted else 1.0) * shared)

    def beams(self, nodes: BeamNodes) -> float:
        """Return the part of interpolated beams, from an estimate of `BeamNodes`.

        Without a measurement in the same way as `delays`. With one, from what each tile's sound makes of the errors:
        beam ``b = hᵀx`` and error ``e = dᵀx`` are sums of the same signals, of covariance R; an envelope errs by

            Re(C_eb)² / C_bb + ½ (C_ee − |C_eb|² / C_bb),   C_eb = dᵀ R h*  and so on.
        """
        covariance = self.signal_model.covariance
        if covariance is None or nodes.is_bent:
            return self._of(_UNLIKE * self.signal_model.colour * float(nodes.errors @ self.signal_model.shares))
        n_tiles, n_waves, _, _ = covariance.shape
        n_directions = nodes.steering.shape[2]
        beams, errors = np.zeros((2, n_tiles, n_directions))
        both = np.zeros((n_tiles, n_directions), dtype=np.complex128)
        for wave in range(n_waves):  # one at a time, so that everything stays in the cache
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
        """Return the part of delays that hold for a zone of ranges.

        Where wavefronts have the curvature b = 1/r, a microphone at p is late by ``b (p² − (u·p)²) / 2c``. What all
        microphones are late by turns the phase of the beam, and shifts its envelope: only the phase at the mean
        frequency has no effect.

        Parameters
        ----------
        aperture : Aperture
        curvature_2 : float
            Mean square of what curvatures differ by from those of their zones, in 1/m²: see `zones.squared_curvature`.
        sound_speed_m_s : float
        """
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
        """Return what plane waves would be wrong by at one range, where spherical ones were wanted; 1 at the most."""
        return min(1.0, self.zones(aperture, max(range_m, NEAREST_M) ** -2, sound_speed_m_s=sound_speed_m_s))

    def samples(self, *, n_terms: int, terms: float, limit: float, weight_limit: float, taps: float) -> float:
        """Return the part of 16-bit numbers.

        Parts of samples are off by a number within ± half a step, and so are parts of weights; a step is the tile's
        largest magnitude by ``limit``, or the largest weight by ``weight_limit``.

        Parameters
        ----------
        n_terms : int
            Of one microphone.
        terms : float
            Sum of their squared weights, 1 where there is one.
        limit, weight_limit : float
            Largest whole number of samples and of weights.
        taps : float
            Sum of the squared weights of the nodes that make a beam, 1 without nodes.
        """
        of_samples = terms * self.signal_model.crest / limit**2 / 6
        of_weights = n_terms / weight_limit**2 / 6
        return self._of(taps * (of_samples + of_weights))

    def nodes(self, *, n_mics: int, sum_of_terms: float, taps: float, filled: float) -> float:
        """Return the part of beams of nodes of which 16 bits are kept: 2⁻¹⁵ of what all terms at full scale add up to.

        Parameters
        ----------
        n_mics : int
        sum_of_terms : float
            Sum of the magnitudes of one microphone's weights, 1 where it has one.
        taps : float
            As for `samples`.
        filled : float
            What they add up to by 2³¹, at most 1.
        """
        step_2 = self.signal_model.crest * n_mics * (sum_of_terms / filled) ** 2 / 2.0**30
        return self._of(taps * step_2 / 6)

    def filter(self, taps: NDArray[np.int16] | NDArray[np.int32]) -> float:
        """Return the part of what the decimation folds into the band: noise beyond it, through the filter's stop band.

        The filter is the one in whole numbers, so that what rounding leaves of its stop band counts. Noise is
        everywhere, and where the image is darker than that, it changes magnitudes by all of itself.
        """
        settings, noise = self._settings, self.signal_model.noise
        low_hz, high_hz = matched_band_hz(settings)
        n_fft = 2 * (len(noise) - 1)
        n_fft *= max(1, -(-8 * len(taps) // n_fft))  # fine enough for the filter's side lobes
        gain_2 = np.abs(np.fft.rfft(taps / taps.sum(dtype=np.int64), n_fft)) ** 2
        frequency_hz = np.arange(len(gain_2)) * settings.recording.sample_rate_hz / n_fft
        folded = gain_2 * np.interp(frequency_hz, np.linspace(0, frequency_hz[-1], len(noise)), noise)
        rate_hz = settings.signal_rate_hz
        distance_hz = np.abs(frequency_hz - rate_hz * np.rint(frequency_hz / rate_hz))
        outside = (frequency_hz > rate_hz / 2) & (distance_hz > low_hz) & (distance_hz < high_hz)
        passed = float(folded[outside].sum()) * (frequency_hz[1] - frequency_hz[0]) / (high_hz - low_hz)
        power = _UNLIKE * passed / self.signal_model.level / self.signal_model.gain
        dark = np.exp(
            -4 * np.sqrt(self.signal_model.places / max(power, 1e-30))
        )  # near the mean of Rice's distribution
        return float(power * (0.5 + 0.5 * np.mean(dark)))

    def arithmetic(self) -> float:
        """Return the error power of single precision.

        PCM microphones may receive the same loud sound outside the band or the window and round it alike, so that their
        errors add up in a beam. PDM bits are as loud whatever is heard, which the measured figure includes.
        """
        if self._settings.recording.is_pdm:
            return _ARITHMETIC / self.signal_model.gain
        alike = effective_count(self._weights)
        return (_ARITHMETIC + alike * _ROUNDING * self.signal_model.loudness) / self.signal_model.gain

    def _of(self, power: float) -> float:
        gain = self.signal_model.gain
        return (0.5 if gain <= 1 else 1 - 0.5 / gain) * power / gain
