"""Means of the bits of 32 channels, with plain NumPy: a capture that checks bits needs no compiled kernel.

Bits are counted in all channels at once: three words become one of sums and one of carries, in five operations on whole
words. The 31 words of a mean become the five binary digits of 32 counts.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.devices.blocks import CHANNELS

__all__ = ["MEAN_OF", "BitMeans"]

MEAN_OF = 31
"""Number of samples in means of bits: the largest number that five binary digits hold."""

_BEFORE = MEAN_OF // 2  # samples of the first mean before the record


class BitMeans:
    """Means of successive bits, full scale 1, centred on every 31st sample. Bits beyond the record count 0."""

    def __init__(self, n_samples: int) -> None:
        n_means = -(-(n_samples + _BEFORE) // MEAN_OF)
        self._inside = slice(_BEFORE, _BEFORE + n_samples)
        self._padded = np.zeros(n_means * MEAN_OF, dtype=np.uint32)
        present = np.zeros(n_means * MEAN_OF, dtype=np.float32)
        present[self._inside] = 1
        self._n_present = present.reshape(n_means, MEAN_OF).sum(axis=1)

    def __call__(self, words: NDArray[np.uint32]) -> NDArray[np.floating[Any]]:
        """Return (channel, n) float32 for words, (sample,) uint32."""
        self._padded[self._inside] = words
        digits = np.stack(_digits(list(np.ascontiguousarray(self._padded.reshape(-1, MEAN_OF).T))))
        bits = np.unpackbits(digits.view(np.uint8), bitorder="little").reshape(len(digits), -1, CHANNELS)
        counts = bits[-1]
        for digit in bits[-2::-1]:
            counts = (counts << 1) | digit
        means = np.ascontiguousarray(counts.T, dtype=np.float32)
        means *= 2
        means -= self._n_present
        means *= np.float32(1 / MEAN_OF)
        return means


def _digits(words: list[NDArray[np.uint32]]) -> list[NDArray[np.uint32]]:
    """Return the binary digits of the number of ones at each bit of the words, the lowest first."""
    carries = []
    while len(words) > 1:
        first, second, third = words[-3:]
        differ = first ^ second
        words[-3:] = [differ ^ third]
        carries.append((first & second) | (differ & third))
    return [words[0], *(_digits(carries) if carries else [])]
