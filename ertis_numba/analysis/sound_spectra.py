"""Spectra of the sound in a record, relative to its stationary noise."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base import fourier
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import microphones

__all__ = ["SoundSpectra", "some_signals", "sound_spectra"]

_TAPERED_S: Final = 0.3e-3  # Length of the taper at each end of the record.
_MAX_SAMPLES: Final = 2**17  # Limit on the memory of long records.
_MAX_HZ: Final = 200e3  # Microphones of air sonars end below it, and the noise of PDM rises.
_EDGE: Final = 0.45  # Highest frequency relative to the sample rate.
_OVERSAMPLING: Final = 4  # Between samples, peaks of the whole band lose up to 5 % of their power.
_FRAME_S: Final = 1e-3
_MIN_FRAME: Final = 64
_FLOOR: Final = 1e-2  # Lowest noise that counts, relative to the loudest frequency: sound must not be all side lobes.


@dataclass(frozen=True, slots=True, eq=False)
class SoundSpectra:
    """Spectra (mic, bin) of some microphones, divided by the magnitude ``noise`` (bin,) of the stationary noise.

    Transforms back to time have ``n_times`` samples at ``time_rate_hz``, which the band needs, not all of the record.
    """

    bins: NDArray[np.complex64]
    noise: NDArray[np.float64]
    frequency_hz: NDArray[np.float64]
    n_samples: int
    n_fft: int
    rate_hz: float

    @property
    def n_times(self) -> int:
        """Number of samples of signals in the band."""
        return min(self.n_fft, fourier.next_fast_len(_OVERSAMPLING * len(self.frequency_hz)))

    @property
    def time_rate_hz(self) -> float:
        """Sample rate of signals in the band."""
        return self.rate_hz * self.n_times / self.n_fft

    @property
    def whole_s(self) -> tuple[float, float]:
        """Start and end of the part of the record that is not tapered, in seconds."""
        return _TAPERED_S, self.n_samples / self.rate_hz - _TAPERED_S

    def band(self, low_hz: float, high_hz: float) -> slice:
        """Return the bins of a band."""
        first, last = np.searchsorted(self.frequency_hz, [low_hz, high_hz])
        return slice(int(first), int(last))


def some_signals(measurement: Measurement, max_mics: int) -> tuple[NDArray[np.float32], float]:
    """Return signals of some microphones, tapered at both ends: (mic, sample), and their sample rate."""
    settings = measurement.settings
    form = sample_format(settings)
    words, _ = form.normalised(form.validated(measurement.data)[:_MAX_SAMPLES])
    channels = np.flatnonzero(microphones(settings.array).enabled).astype(np.int32)
    channels = np.ascontiguousarray(channels[:: max(1, -(-len(channels) // max_mics))])
    signals = np.empty((len(channels), len(words)), dtype=np.float32)
    plain = kernels.load("numpy")  # These kernels need no compilation.
    if settings.recording.is_pdm:
        plain.unpack_bits(words, channels, signals)
    else:
        scale = np.float32(1 / settings.recording.full_scale)
        plain.unpack_pcm(words, channels, scale, np.float32(0), 0, signals)
    rate_hz = settings.recording.sample_rate_hz
    # Without a taper, a hum below the band would cause clicks at both ends.
    edge = np.arange(len(words)) / (_TAPERED_S * rate_hz)
    signals *= np.sin(np.pi / 2 * np.minimum(1.0, np.minimum(edge, edge[::-1]))).astype(np.float32) ** 2
    return signals, rate_hz


def sound_spectra(signals: NDArray[np.float32], rate_hz: float, *, low_hz: float, padding_s: float) -> SoundSpectra:
    """Return spectra from ``low_hz`` on, in which stationary noise and tones are flat, with zeros of ``padding_s``."""
    n_samples = signals.shape[1]
    n_fft = fourier.next_fast_len(n_samples + round(padding_s * rate_hz), real=True)
    high_hz = min(_EDGE * rate_hz, _MAX_HZ)
    bins = np.arange(max(1, round(low_hz * n_fft / rate_hz)), round(high_hz * n_fft / rate_hz) + 1)
    frequency_hz = bins * rate_hz / n_fft
    length = min(n_samples, max(_MIN_FRAME, round(_FRAME_S * rate_hz)))
    count = n_samples // length
    frames = signals[:, : count * length].reshape(-1, count, length) * np.hanning(length).astype(np.float32)
    power = np.abs(fourier.rfft(frames)) ** 2
    of_noise = np.median(power, axis=1).mean(axis=0) / math.log(2)
    at_hz = np.arange(len(of_noise)) * rate_hz / length
    loudest = float(np.interp(frequency_hz, at_hz, power.mean(axis=(0, 1))).max(initial=0.0))
    noise = np.sqrt(np.maximum(np.interp(frequency_hz, at_hz, of_noise), _FLOOR * loudest + 1e-300))
    spectra = np.empty((len(signals), len(bins)), np.complex64)
    for each, signal in zip(spectra, signals, strict=True):  # One by one, because long records need much memory.
        each[:] = fourier.rfft(signal, n_fft)[bins] / noise
    return SoundSpectra(spectra, noise, frequency_hz, n_samples, n_fft, rate_hz)
