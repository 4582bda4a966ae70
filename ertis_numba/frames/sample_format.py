"""Type and shape of the data of a measurement: PDM words with one bit per microphone, or PCM numbers."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings

__all__ = ["SampleFormat", "sample_format"]

_MAX_EXPONENT = 20  # of two: squares, products and sums of samples from 1e-6 to 1e6 stay within single precision


class SampleFormat(NamedTuple):
    """Type and shape of the words of one measurement."""

    dtype: np.dtype[Any]  # little-endian, as in files and messages
    shape: tuple[int, ...]  # (sample,), (sample, word) for several PDM words, or (sample, channel) for PCM

    @property
    def n_bytes(self) -> int:
        """Size of a measurement in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def shape_2d(self) -> tuple[int, int]:
        """Shape with two axes, even for one word per sample."""
        return self.shape[0], self.shape[1] if len(self.shape) > 1 else 1

    def from_bytes(self, content: bytes | bytearray | memoryview) -> NDArray[Any]:
        """Return a view of bytes as words; raise DataError if their number is wrong."""
        if len(content) != self.n_bytes:
            raise DataError(
                f"measurement has {len(content)} bytes, but its settings describe {self.n_bytes}; use the settings "
                "that it was recorded with"
            )
        return np.frombuffer(content, self.dtype).reshape(self.shape)

    def validated(self, words: NDArray[Any], *, any_length: bool = False) -> NDArray[Any]:
        """Return finite words of shape (sample, word), in the memory order and alignment for kernels."""
        n_samples = len(words) if any_length else self.shape[0]
        shape, rows = (n_samples, *self.shape[1:]), (n_samples, self.shape_2d[1])
        if words.dtype != self.dtype or words.shape not in {shape, rows}:
            raise DataError(
                f"measurement has {words.dtype} words of shape {words.shape}, but its settings describe "
                f"{self.dtype.name} of shape {shape}; use the settings that it was recorded with"
            )
        if self.dtype.kind == "f" and not np.isfinite(words).all():
            sample, channel = np.argwhere(~np.isfinite(words.reshape(rows)))[0].tolist()
            came = words.reshape(rows)[sample, channel]
            raise DataError(f"measurement holds {came} at sample {sample} of channel {channel}; pass finite numbers")
        # Kernels would be compiled again for read-only or unaligned arrays.
        return np.require(words, requirements=["C", "A", "W"]).reshape(rows)

    def normalised(self, words: NDArray[Any]) -> tuple[NDArray[Any], int]:
        """Return validated words in the range of single precision, and the exponent n of the divisor 2^n."""
        # Only floating-point words are scaled, if their largest magnitude is far from 1. Images are linear in the
        # words.
        if self.dtype.kind != "f" or not words.size:
            return words, 0
        largest = max(float(words.max()), -float(words.min()))
        exponent = math.frexp(largest)[1] if largest else 0
        if abs(exponent) <= _MAX_EXPONENT:
            return words, 0
        return np.ldexp(words.astype(np.float64), -exponent).astype(self.dtype), exponent


def sample_format(settings: Settings) -> SampleFormat:
    """Return the type and shape of measurements; raise ArgumentError if the layout cannot be used."""
    layout, recording = microphones(settings.array), settings.recording
    if not recording.is_pdm:
        return SampleFormat(np.dtype(recording.encoding).newbyteorder("<"), (recording.n_samples, len(layout.enabled)))
    shape = (recording.n_samples,) if layout.n_words == 1 else (recording.n_samples, layout.n_words)
    return SampleFormat(layout.word_type, shape)
