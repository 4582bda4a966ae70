"""Noise that reaches every microphone with its own delay."""

import math

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ertis_numba import kernels

__all__ = ["NoiseField"]

_FRAME = 16_384  # samples: some milliseconds
_SKIRT = 16  # bins of a frame by which its window widens the band, down to -60 dB
_EARLIEST = 2**32
_SHARED = 3  # frames that reach from one block into the next


class NoiseField:
    """Band-limited Gaussian noise from some directions, independent of each other.

    Made in frames of half overlap under a sine window, whose squares add up to 1. Each direction has a random
    signal in each frame, which every microphone hears, window and all, with its own delay and amplitude.

    Parameters
    ----------
    seed : tuple of int
        Decides the noise, together with the number of the frame.
    delay_s, amplitude : (direction, mic) float64
        Delays from the middle of the array: what counts is how they differ.
    band_hz : (low, high)
    rate_hz : float
    """

    def __init__(
        self,
        seed: tuple[int, ...],
        *,
        delay_s: NDArray[np.float64],
        amplitude: NDArray[np.float64],
        band_hz: tuple[float, float],
        rate_hz: float,
    ) -> None:
        self._seed = seed
        self._margin = math.ceil(np.abs(delay_s).max() * rate_hz) + 1
        self._n_fft = int(scipy.fft.next_fast_len(_FRAME + 2 * self._margin, real=True))
        low, high = (edge_hz * _FRAME / rate_hz for edge_hz in (band_hz[0], min(band_hz[1], rate_hz / 2)))
        self._drawn = np.arange(math.ceil(low), max(math.ceil(low), math.floor(high)) + 1)
        self._first_bin, stop = (round(self._n_fft / _FRAME * edge) for edge in (low - _SKIRT, high + _SKIRT))
        self._first_bin = max(self._first_bin, 0)
        self._n_bins = min(stop, self._n_fft // 2 + 1) - self._first_bin
        self._turns = delay_s * rate_hz / self._n_fft
        self._amplitude = amplitude[..., None]
        self._window = np.sin(math.pi * (np.arange(_FRAME) + 0.5) / _FRAME)
        self._kernels = kernels.load("cpu")
        self._frames: dict[int, NDArray[np.float64]] = {}  # the last ones, which two blocks share

    def add_to(self, signals: NDArray[np.float64], first: int) -> None:
        """Add the noise of samples ``first`` and on: (mic, sample) float64, in place."""
        hop = _FRAME // 2
        stop = first + signals.shape[1]
        for number in range((first - self._margin) // hop - 1, -(-(stop + self._margin) // hop)):
            begin = number * hop - self._margin  # of what is heard of the frame anywhere
            here = slice(max(begin, first), min(begin + _FRAME + 2 * self._margin, stop))
            if here.start < here.stop:
                frame = self._frame(number)
                signals[:, here.start - first : here.stop - first] += frame[:, here.start - begin : here.stop - begin]

    def _frame(self, number: int) -> NDArray[np.float64]:
        """Return what the microphones hear of a frame, from its margin on: (mic, sample) float64."""
        if number not in self._frames:
            # Frames begin before the record; a seed is no negative number.
            random = np.random.default_rng(np.random.SeedSequence((*self._seed, number + _EARLIEST)))
            spectra = np.zeros((self._turns.shape[1], self._n_fft // 2 + 1), dtype=np.complex128)
            part = np.zeros((len(spectra), self._n_bins), dtype=np.complex128)
            for direction in range(len(self._turns)):
                one = slice(direction, direction + 1)
                bins = slice(self._first_bin, self._first_bin + self._n_bins)
                sound = scipy.fft.rfft(self._source(random), self._n_fft)[None, bins]
                self._kernels.add_paths(sound, self._turns[one], self._amplitude[one], self._first_bin, 0.0, part)
            spectra[:, self._first_bin : self._first_bin + self._n_bins] = part
            heard = scipy.fft.irfft(spectra, self._n_fft, workers=self._kernels.max_threads)
            self._frames = {n: frame for n, frame in self._frames.items() if n > number - _SHARED}
            self._frames[number] = np.roll(heard, self._margin, axis=1)
        return self._frames[number]

    def _source(self, random: np.random.Generator) -> NDArray[np.float64]:
        """Return one frame of noise of root mean square 1 under its window: (sample,) float64."""
        spectrum = np.zeros(_FRAME // 2 + 1, dtype=np.complex128)
        parts = random.standard_normal((2, len(self._drawn)))
        spectrum[self._drawn] = _FRAME / math.sqrt(4 * len(self._drawn)) * (parts[0] + 1j * parts[1])
        return np.asarray(scipy.fft.irfft(spectrum, _FRAME) * self._window)
