"""What the words of a measurement look like: bits of all microphones at a tick of the PDM clock, or PCM numbers."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import DataError
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings

__all__ = ["SampleFormat", "sample_format"]

_MAX_EXPONENT = 20  # of two: samples from 1e-6 to 1e6 leave single precision room for squares, products and sums


class SampleFormat(NamedTuple):
    """Type and shape of the words of one measurement.

    Attributes
    ----------
    dtype : numpy.dtype
        Little-endian, as they are stored and sent.
    shape : tuple of int
        ``(sample,)``, or ``(sample, word)`` where a PDM tick takes several words; ``(sample, channel)`` of PCM.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def n_bytes(self) -> int:
        """Size of a measurement."""
        return int(np.prod(self.shape)) * self.dtype.itemsize

    @property
    def shape_2d(self) -> tuple[int, int]:
        """The shape with both axes, also where there is one word per sample."""
        return self.shape[0], self.shape[1] if len(self.shape) > 1 else 1

    def from_bytes(self, content: bytes | bytearray | memoryview) -> NDArray[Any]:
        """Return the words that lie in memory, which is not copied.

        Raises
        ------
        DataError
            They are not as many.
        """
        if len(content) != self.n_bytes:
            raise DataError(f"a measurement has {len(content)} bytes, its settings want {self.n_bytes}")
        return np.frombuffer(content, self.dtype).reshape(self.shape)

    def validated(self, words: NDArray[Any], *, any_length: bool = False) -> NDArray[Any]:
        """Return words as ``(sample, word)``, in the order and alignment that kernels are compiled for.

        Raises
        ------
        DataError
            Their type or shape is another, or PCM holds a number that is not finite.
        """
        n_samples = len(words) if any_length else self.shape[0]
        shape, rows = (n_samples, *self.shape[1:]), (n_samples, self.shape_2d[1])
        if words.dtype != self.dtype or words.shape not in {shape, rows}:
            raise DataError(
                f"measurement holds {words.dtype} words of shape {words.shape}; its settings want "
                f"{self.dtype.name} of shape {shape}: give the settings that it was recorded with"
            )
        if self.dtype.kind == "f" and not np.isfinite(words).all():
            sample, channel = np.argwhere(~np.isfinite(words.reshape(rows)))[0].tolist()
            came = words.reshape(rows)[sample, channel]
            raise DataError(f"measurement holds {came} at sample {sample} of channel {channel}; give finite numbers")
        # Read-only or unaligned arrays would each be a type of their own to compile the kernels for.
        return np.require(words, requirements=["C", "A", "W"]).reshape(rows)

    def normalised(self, words: NDArray[Any]) -> tuple[NDArray[Any], int]:
        """Return words scaled into the range of single precision, and the exponent of the divisor 2^n.

        Images are linear in the words, so the caller multiplies the image by the same power of two. Only floating-point
        words are scaled, and only if their largest magnitude is far from 1.

        Parameters
        ----------
        words : array
            As `validated` returns them.
        """
        if self.dtype.kind != "f" or not words.size:
            return words, 0
        largest = max(float(words.max()), -float(words.min()))
        exponent = math.frexp(largest)[1] if largest else 0
        if abs(exponent) <= _MAX_EXPONENT:
            return words, 0
        return np.ldexp(words.astype(np.float64), -exponent).astype(self.dtype), exponent


def sample_format(settings: Settings) -> SampleFormat:
    """Return what the words of such measurements look like.

    Raises
    ------
    ArgumentError
        The layout is unknown or cannot be used.
    """
    layout, recording = microphones(settings.array), settings.recording
    if not recording.is_pdm:
        return SampleFormat(np.dtype(recording.encoding).newbyteorder("<"), (recording.n_samples, len(layout.enabled)))
    shape = (recording.n_samples,) if layout.n_words == 1 else (recording.n_samples, layout.n_words)
    return SampleFormat(layout.word_type, shape)
