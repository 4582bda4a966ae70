"""Noise that reaches every microphone with its own delay."""

import math

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ertis_numba import kernels

__all__ = ["NoiseField"]

_FRAME = 16_384  # samples: some milliseconds, far longer than any way across an array


class NoiseField:
    """Band-limited Gaussian noise from some directions, independent of each other.

    Made in frames of half overlap under a sine window, whose squares add up to 1; within a frame
    each direction has a random spectrum, which every microphone hears with its own delay and amplitude.

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
        spacing_hz = rate_hz / _FRAME
        low = math.ceil(band_hz[0] / spacing_hz)
        self._bins = np.arange(low, max(low, math.floor(min(band_hz[1], rate_hz / 2) / spacing_hz)) + 1)
        self._turns = delay_s * spacing_hz
        self._amplitude = amplitude[..., None]
        self._window = np.sin(math.pi * (np.arange(_FRAME) + 0.5) / _FRAME)
        self._kernels = kernels.load("cpu")
        self._last: tuple[int, NDArray[np.float64]] = (-2, np.zeros(0))

    def add_to(self, signals: NDArray[np.float64], first: int) -> None:
        """Add the noise of samples ``first`` and on: (mic, sample) float64, in place."""
        hop = _FRAME // 2
        stop = first + signals.shape[1]
        for number in range(first // hop - 1, -(-stop // hop)):
            begin = number * hop
            here = slice(max(begin, first) - first, min(begin + _FRAME, stop) - first)
            signals[:, here] += self._frame(number)[:, here.start + first - begin : here.stop + first - begin]

    def _frame(self, number: int) -> NDArray[np.float64]:
        if number != self._last[0]:
            random = np.random.default_rng(np.random.SeedSequence((*self._seed, number + 1)))
            spectra = np.zeros((self._turns.shape[1], _FRAME // 2 + 1), dtype=np.complex128)
            part = np.zeros((len(spectra), len(self._bins)), dtype=np.complex128)
            scale = _FRAME / math.sqrt(2 * len(self._bins)) / math.sqrt(2)
            for direction in range(len(self._turns)):
                drawn = scale * random.standard_normal((2, len(self._bins)))
                self._kernels.add_paths(
                    (drawn[0] + 1j * drawn[1])[None],
                    self._turns[direction : direction + 1],
                    self._amplitude[direction : direction + 1],
                    int(self._bins[0]),
                    0.0,
                    part,
                )
            spectra[:, self._bins] = part
            frame = scipy.fft.irfft(spectra, _FRAME, workers=self._kernels.max_threads)
            self._last = number, frame * self._window
        return self._last[1]
