"""Power spectra of streams, which are nonlinear functions of signals, and errors of their delays for one echo."""

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import fourier
from ertis_numba.chain.interpolation_fit import WAVES, DelayFit, Spectrum
from ertis_numba.settings.beamformers import SignalStream

__all__ = ["StreamSpectrum", "highest_hz", "pulse_errors", "spectrum_of_stream"]

_LENGTH, _RUNS = 2**15, 6  # Samples and repetitions of the noise.
_OVERSAMPLING = 48  # Beyond this bandwidth, streams have less power than any plan with 64 samples per range misses.
_TAIL_BINS = 12
_FAINT = 1e-3  # Levels below this share of the largest count as this share.
_SEED = 1
_PULSE_WIDTHS, _PULSE_DENSITY = 6, 12  # Length of half a pulse, and its samples, relative to the reciprocal bandwidth.
_KEPT = 64  # Number of cached spectra.
_KEPT_FITS = 512


class StreamSpectrum(NamedTuple):
    """Spectrum of a stream where the image is bright, to which weights are fitted, and the whole one in noise."""

    bright: Spectrum
    whole: Spectrum


@functools.lru_cache(maxsize=_KEPT)
def spectrum_of_stream(spectrum: Spectrum, stream: SignalStream) -> StreamSpectrum:
    """Return the spectra of a stream of signals with a given spectrum."""
    # Weighted by brightness, a stream has the bandwidth of the signals times `√((a² + k²) / 2)`.
    if stream.power == 1 and stream.turns == 1:
        return StreamSpectrum(spectrum, spectrum)
    stretch = math.sqrt((stream.power**2 + stream.turns**2) / 2)
    centre_hz = stream.turns * spectrum.centre_hz
    frequency_hz, power = stretch * (spectrum.frequency_hz - spectrum.centre_hz), spectrum.power
    if stream.turns == 0:  # The spectrum is symmetric, so that weights are real.
        frequency_hz, power = (frequency_hz - frequency_hz[::-1]) / 2, (power + power[::-1]) / 2
    return StreamSpectrum(Spectrum(centre_hz + frequency_hz, power), _whole(spectrum, stream, stretch))


def highest_hz(low_hz: float, high_hz: float, stream: SignalStream) -> float:
    """Return the highest frequency of a stream for a call of a given band, to which beam grids are relative."""
    return stream.turns * (low_hz + high_hz) / 2 + max(1.0, stream.power) * (high_hz - low_hz) / 2


@functools.lru_cache(maxsize=_KEPT_FITS)
def pulse_errors(fit: DelayFit, spectrum: Spectrum, stream: SignalStream) -> tuple[float, float]:
    """Return the error powers of a stream's delays for one echo that reaches all microphones alike."""
    # The envelope of an echo has zeros, where streams change suddenly. The second result is the error that all share.
    frequency_hz, power = spectrum.frequency_hz, spectrum.power
    width_hz = float(frequency_hz[-1] - frequency_hz[0]) + 1.0
    time_s = np.arange(-_PULSE_WIDTHS * _PULSE_DENSITY, _PULSE_WIDTHS * _PULSE_DENSITY) / (_PULSE_DENSITY * width_hz)
    # Stored samples of each fraction of a step: (fraction, tap, time).
    shift_s = (np.arange(fit.n_taps) - fit.fractions[:, None]) * fit.step_s
    shifted = np.exp(2j * np.pi * frequency_hz * shift_s[..., None]) * power
    stored = _values(shifted @ np.exp(2j * np.pi * frequency_hz[:, None] * time_s), stream)
    signal = power @ np.exp(2j * np.pi * frequency_hz[:, None] * time_s)
    level = np.abs(signal)
    wrong = np.einsum("ak,akt->at", fit.weights(fit.fractions), stored) - _values(signal, stream)
    wrong *= np.maximum(level, _FAINT * level.max()) ** (1 - stream.power)
    if stream.power > 1:
        wrong /= np.maximum(1.0, np.abs(wrong) / np.maximum(level, _FAINT * level.max()))
    shared = float(np.sum(np.abs(wrong.mean(axis=0)) ** 2))
    whole = float(np.mean(np.sum(np.abs(wrong) ** 2, axis=1)))
    total = float(np.sum(level**2))
    return (whole - shared) / total, shared / total


def _whole(spectrum: Spectrum, stream: SignalStream, stretch: float) -> Spectrum:
    """Return the spectrum of a stream of Gaussian noise."""
    frequency_hz, centre_hz = spectrum.frequency_hz, spectrum.centre_hz
    width_hz = float(frequency_hz[-1] - frequency_hz[0]) + 1.0
    bins_hz = np.fft.fftfreq(_LENGTH, 1 / (_OVERSAMPLING * width_hz))
    density = spectrum.power / np.gradient(frequency_hz) if len(frequency_hz) > 1 else spectrum.power
    root = np.sqrt(np.interp(bins_hz + centre_hz, frequency_hz, density, left=0.0, right=0.0))
    random = np.random.default_rng(_SEED)
    power = np.zeros(_LENGTH)
    for _ in range(_RUNS):
        parts = random.standard_normal((2, _LENGTH))
        noise = fourier.ifft(root * (parts[0] + 1j * parts[1]))
        power += np.abs(fourier.fft(_values(noise, stream))) ** 2
    # Even bins in the middle, and geometric ones in the tails.
    inner_hz, outer_hz = stretch * width_hz / 2, float(np.abs(bins_hz).max()) * (1 + 1e-9)
    tail_hz = np.geomspace(inner_hz, max(2 * inner_hz, outer_hz), _TAIL_BINS + 1)[1:]
    edges_hz = np.concatenate([-tail_hz[::-1], np.linspace(-inner_hz, inner_hz, WAVES + 1), tail_hz])
    place = np.clip(np.searchsorted(edges_hz, bins_hz) - 1, 0, len(edges_hz) - 2)
    found = np.bincount(place, power, minlength=len(edges_hz) - 1)
    return Spectrum(stream.turns * centre_hz + (edges_hz[1:] + edges_hz[:-1]) / 2, found / found.sum())


def _values(signals: NDArray[np.complex128], stream: SignalStream) -> NDArray[np.complex128]:
    """Return the values of a stream."""
    level = np.abs(signals)
    unit = np.divide(signals, level, out=np.zeros_like(signals), where=level > 0)
    return np.asarray(np.power(level, stream.power, out=np.zeros_like(level), where=level > 0) * unit**stream.turns)
