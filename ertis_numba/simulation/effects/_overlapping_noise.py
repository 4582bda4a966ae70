"""Continuous noise, generated in overlapping frames."""

import math
from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

__all__ = ["FRAME", "OverlappingFrames", "band_bins", "drawn", "window"]

Floats = NDArray[np.float64]

FRAME = 16_384
"""Samples per frame: some milliseconds."""
_EARLIEST = 2**32  # offset of frame numbers: frames begin before the record, and seeds must not be negative
_SHARED = 3  # frames that extend from one block into the next


class OverlappingFrames:
    """Sums frames (mic, sample) from ``make`` that overlap by half; with `window`, their powers add up to 1."""

    def __init__(self, seed: tuple[int, ...], make: Callable[[np.random.Generator], Floats]) -> None:
        self._seed, self._make = seed, make
        self._frames: dict[int, Floats] = {}

    def add_to(self, signals: Floats, first: int) -> None:
        """Add the noise to ``signals``, which start at sample ``first``, in place: (mic, sample) float64."""
        hop, stop = FRAME // 2, first + signals.shape[1]
        for number in range(first // hop - 1, -(-stop // hop)):
            begin = number * hop
            low, high = max(begin, first), min(begin + FRAME, stop)
            if low < high:
                signals[:, low - first : high - first] += self._frame(number)[:, low - begin : high - begin]

    def _frame(self, number: int) -> Floats:
        if number not in self._frames:
            random = np.random.default_rng(np.random.SeedSequence((*self._seed, number + _EARLIEST)))
            kept = {earlier: frame for earlier, frame in self._frames.items() if earlier > number - _SHARED}
            self._frames = {**kept, number: self._make(random)}
        return self._frames[number]


def window() -> Floats:
    """Return a half-sine window: (sample,) float64. Its squares add up to 1 over frames that overlap by half."""
    return np.asarray(np.sin(math.pi * (np.arange(FRAME) + 0.5) / FRAME))


def band_bins(band_hz: tuple[float, float], rate_hz: float) -> NDArray[np.int64]:
    """Return the bins of a frame's spectrum in a band, at least one: (bin,) int64."""
    low = math.ceil(band_hz[0] * FRAME / rate_hz)
    high = math.floor(min(band_hz[1], rate_hz / 2) * FRAME / rate_hz)
    return np.arange(low, max(low, high) + 1)


def drawn(random: np.random.Generator, bins: NDArray[np.int64], mix: NDArray[np.float64]) -> Floats:
    """Return frames (row, sample) of noise with an RMS of 1 in some bins, mixed from sources by (bin, row, source)."""
    n_sources = mix.shape[2]
    parts = random.standard_normal((2, len(bins), n_sources, 1))
    spectra = np.zeros((mix.shape[1], FRAME // 2 + 1), dtype=np.complex128)
    spectra[:, bins] = FRAME / math.sqrt(4 * len(bins)) * (mix @ parts[0] + 1j * (mix @ parts[1]))[..., 0].T
    return np.asarray(scipy.fft.irfft(spectra, FRAME))
