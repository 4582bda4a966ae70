"""Noise of a source as a sequence of short waveforms, which travel to the microphones like calls."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.simulation.sources import Noise

__all__ = ["CREST", "FRAME_S", "NoiseFrame", "frame_of", "frames_between", "spectrum_of", "top_hz"]

Floats = NDArray[np.float64]

FRAME_S = 4e-3
"""Duration of a frame. Sound travels with constant velocities during each frame."""
CREST = 4.5
"""Highest of some hundred thousand Gaussian numbers, relative to their RMS."""
_SKIRT_HZ = 20 / FRAME_S  # from here on, the spectrum of the window is below −90 dB
_EARLIEST = 2**32  # offset of frame numbers: sound may leave before the first measurement, and seeds are not negative
_OVERSAMPLING = 32  # samples per period before spline interpolation, whose error is then −108 dB


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFrame:
    """One frame of a source's noise, RMS 1 before its window; frames overlap by half, their powers add up to 1."""

    noise: Noise
    seed: tuple[int, ...]

    @property
    def end_s(self) -> float:
        """End after the start of the frame, in seconds."""
        return FRAME_S

    @property
    def high_frequency_hz(self) -> float:
        """Upper end of the band in hertz."""
        return self.noise.band_hz[1]

    def at(self, time_s: Floats) -> Floats:
        """Return the waveform at times after the start of the frame, shaped like the input; it is 0 outside."""
        return np.asarray(np.nan_to_num(_interpolator(self)(time_s)))


def frames_between(begin_s: float, end_s: float) -> range:
    """Return the numbers of the frames that overlap an interval of the scene; frame n begins at ``n FRAME_S / 2``."""
    return range(math.floor(2 * begin_s / FRAME_S) - 1, math.ceil(2 * end_s / FRAME_S))


def frame_of(noise: Noise, seed: tuple[int, ...], number: int) -> NoiseFrame:
    """Return a frame of a source's noise by its number, the same for all sensors, measurements and sample rates."""
    return NoiseFrame(noise, (*seed, number + _EARLIEST))


def top_hz(noise: Noise) -> float:
    """Return the upper end of the spectrum of a frame, 90 dB below its maximum."""
    return noise.band_hz[1] + _SKIRT_HZ


def spectrum_of(noise: Noise) -> tuple[Floats, Floats]:
    """Return multiples of the inverse duration of a frame, and the shares of a noise's power: (frequency,)."""
    low, high = (math.ceil(noise.band_hz[0] * FRAME_S), math.floor(noise.band_hz[1] * FRAME_S))
    frequency_hz = np.arange(low, max(low, high) + 1) / FRAME_S
    density = noise.density(frequency_hz)
    return frequency_hz, density / density.sum()


@functools.lru_cache(maxsize=4)
def _interpolator(frame: NoiseFrame) -> scipy.interpolate.CubicSpline:
    """Return the windowed noise ``w(t) Re Σ A exp(2πi f t)`` as a spline that is NaN outside the frame."""
    # The window `sin(π/2 sin²(πt/T))` preserves the power, and has lower side lobes than a half sine (Vorbis I).
    frequency_hz, power = spectrum_of(frame.noise)
    bins = np.rint(frequency_hz * FRAME_S).astype(int)
    n_samples = 1 << math.ceil(math.log2(_OVERSAMPLING * (bins[-1] + 1)))
    parts = np.random.default_rng(np.random.SeedSequence(frame.seed)).standard_normal((2, len(bins)))
    spectrum = np.zeros(n_samples // 2 + 1, dtype=np.complex128)
    spectrum[bins] = np.sqrt(power) * (parts[0] + 1j * parts[1]) * n_samples / 2
    periodic = scipy.fft.irfft(spectrum, n_samples)
    phase = math.pi * np.arange(n_samples + 1) / n_samples
    window = np.sin(math.pi / 2 * np.sin(phase) ** 2)
    time_s = np.arange(n_samples + 1) * (FRAME_S / n_samples)
    values = np.append(periodic, periodic[0]) * window
    return scipy.interpolate.CubicSpline(time_s, values, extrapolate=False)
