"""Levels of imported samples: clipping, and floating-point samples on the scale of integers."""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["SampleLevels"]

_MIN_CLIPPED: Final = 5  # Fewer samples at full scale may be the single peaks of a normalised file.
_TOP: Final = 1 - 2.0**-23  # Largest sample of 24 bits.
_TOP_OF_BYTES: Final = 127 * 256
_LARGE: Final = 4.0  # Floating-point samples above full scale are possible, but not that far.
_SCALES: Final = (2.0**15, 2.0**23, 2.0**31)


class SampleLevels:
    """Peak and number of samples at full scale of the samples of a file.

    Parameters
    ----------
    full_scale : float
        Full scale of the samples.
    is_bytes, is_float : bool
        Whether the file contains samples of 8 bits, or floating-point samples.
    """

    def __init__(self, full_scale: float, *, is_bytes: bool, is_float: bool) -> None:
        self._top = _TOP_OF_BYTES if is_bytes else _TOP if full_scale == 1 else full_scale - 1
        self._bottom = -full_scale
        self._is_float = is_float
        self._peak = 0.0
        self._n_clipped = np.zeros(0, np.int64)

    def add(self, samples: NDArray[Any]) -> None:
        """Count the samples of a block, (sample, channel)."""
        clipped = np.count_nonzero((samples >= self._top) | (samples <= self._bottom), axis=0)
        self._n_clipped = clipped if not self._n_clipped.size else self._n_clipped + clipped
        if self._is_float and samples.size:
            self._peak = max(self._peak, float(samples.max()), -float(samples.min()))

    @property
    def note(self) -> str:
        """Note on samples that are clipped or on another scale; empty if there are none."""
        if self._peak > _LARGE:
            scale = next((each for each in _SCALES if self._peak <= each), self._peak)
            return (
                f"floating-point samples reach {self._peak:.6g}, but their full scale is 1, so levels are up to "
                f"{20 * math.log10(scale):.0f} dB too high; divide the samples by {scale:g}"
            )
        if self._peak > 1:  # A converter of floating-point samples does not clip at 1.
            return ""
        channels = np.flatnonzero(self._n_clipped >= _MIN_CLIPPED)
        if not len(channels):
            return ""
        named = ", ".join(map(str, channels[:8])) + (", …" if len(channels) > 8 else "")
        return (
            f"{self._n_clipped[channels].sum()} samples of channel{'s' * (len(channels) > 1)} {named} are at full "
            "scale, so they are probably clipped"
        )
