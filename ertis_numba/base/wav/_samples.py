"""Samples of a WAV file, converted where NumPy has no type of their size."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Samples", "samples_of"]

_SIZES = (1, 2, 4, 8)  # bytes of NumPy's integers


class Samples(Protocol):
    """Samples as (sample, channel), such as an array; slices along the first axis are arrays."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the slices."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of samples and of channels."""

    def __getitem__(self, samples: slice, /) -> NDArray[Any]:
        """Return consecutive samples."""


def samples_of(content: NDArray[np.uint8], n_channels: int, sample_bytes: int, kind: str, order: str) -> Samples:
    """Return a view of complete frames (byte,) as samples; ``kind`` is ``i`` or ``f``, ``order`` is ``<`` or ``>``."""
    if sample_bytes in _SIZES:
        dtype = np.dtype("u1" if sample_bytes == 1 else f"{order}{kind}{sample_bytes}")
        return content.view(dtype).reshape(-1, n_channels)
    wide = next(size for size in _SIZES if size > sample_bytes)
    return _Packed(content.reshape(-1, n_channels, sample_bytes), np.dtype(f"{order}i{wide}"))


@dataclass(frozen=True, slots=True)
class _Packed:
    """Integers of 3, 5, 6 or 7 bytes; slices fill the low bytes of the next larger type with zeros."""

    content: NDArray[np.uint8]
    dtype: np.dtype[Any]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.content.shape[:2]

    def __getitem__(self, samples: slice) -> NDArray[Any]:
        packed = self.content[samples]
        wide = np.zeros((*packed.shape[:2], self.dtype.itemsize), np.uint8)
        missing = self.dtype.itemsize - packed.shape[2]
        used = slice(missing, None) if self.dtype == self.dtype.newbyteorder("<") else slice(packed.shape[2])
        wide[..., used] = packed
        return wide.view(self.dtype)[..., 0]
