"""Images as 8-bit levels in decibels."""

import math
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError, DataError

__all__ = ["MAX_STEP_DB", "ROUNDING_DB", "LevelCodes", "as_dtype", "rounding_db", "rounding_np"]

MAX_STEP_DB: Final = 10.0
_STEP_DB: Final = 0.5
_LAST: Final = 255
_TOP_DBFS: Final = 5.0  # One-bit sound at full scale reaches 2.1 dBFS.
_QUIET_DB: Final = 30.0  # Level above the floor, below which a single image has a scale of its own.
_QUIETEST_DBFS: Final = -600.0  # Levels of single precision, whose logarithms are exact enough, begin here.
_OCTAVE_DB: Final = 20 * math.log10(2)


class LevelCodes(NamedTuple):
    """Scale of 8-bit levels: code c from 1 to 255 is ``floor_db + (c - 1) * step_db`` in dBFS.

    Code 0 is a level more than half a step below ``floor_db``, or no sound.
    """

    floor_db: float
    step_db: float = _STEP_DB

    @classmethod
    def checked(cls, floor_db: object, step_db: object, source: str) -> Self:
        """Return the scale that a file or message states, or raise DataError."""
        try:
            made = cls(float(floor_db), float(step_db))  # type: ignore[arg-type]
        except (TypeError, ValueError):
            made = cls(math.nan)
        if not (abs(made.floor_db) <= 1000 and 0 < made.step_db <= MAX_STEP_DB):
            raise DataError(
                f"{source} has 8-bit levels from {floor_db} dB in steps of {step_db} dB; state finite numbers, the "
                f"step from 0 to {MAX_STEP_DB:g} dB"
            )
        return made

    @classmethod
    def of(cls, amplitude: NDArray[np.float32], *, headroom_db: float = 0.0) -> Self:
        """Return the usual scale, or another one if an image is louder, or quieter and no others will follow."""
        usual = cls.up_to(_TOP_DBFS)
        highest = float(amplitude.max(initial=0.0))
        if not 0 < highest < math.inf:
            return usual
        level_db = 20 * math.log10(highest)
        is_quiet = not headroom_db and level_db < usual.floor_db + _QUIET_DB
        if level_db <= _TOP_DBFS - headroom_db and not is_quiet:
            return usual
        return cls.up_to(max(level_db + headroom_db, _QUIETEST_DBFS))

    @classmethod
    def up_to(cls, level_db: float) -> Self:
        """Return the scale that ends at a level, rounded up."""
        return cls(_STEP_DB * (math.ceil(level_db / _STEP_DB) - _LAST + 1))

    @property
    def top_db(self) -> float:
        """Level of the largest code."""
        return self.floor_db + self.step_db * (_LAST - 1)

    def encode(self, amplitude: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the codes of an image; raise ArgumentError if one amplitude has none."""
        given = np.ascontiguousarray(amplitude, np.float32)
        out = np.empty(given.shape, np.uint8)
        floor, steps = np.float32(self.floor_db / _OCTAVE_DB), np.float32(_OCTAVE_DB / self.step_db)
        kernels.load_points().encode_levels(given.reshape(-1).view(np.int32), floor, steps, out.reshape(-1))
        if out.max(initial=0) == _LAST:  # Also of negative numbers, infinity and NaN.
            lowest, highest = float(given.min()), float(given.max())
            if not lowest >= 0 or not highest <= 10 ** ((self.top_db + self.step_db / 2) / 20):
                raise ArgumentError(
                    f"amplitudes from {lowest:g} to {highest:g} do not fit 8-bit levels from {self.floor_db:g} to "
                    f"{self.top_db:g} dBFS; use dtype float32"
                )
            if np.signbit(given).any():  # zeros
                return self.encode(np.abs(given))
        return out

    def decode(self, codes: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the amplitudes of codes; 0 for code 0."""
        amplitude = 10 ** ((self.floor_db + self.step_db * np.arange(-1, _LAST)) / 20)
        amplitude[0] = 0.0
        return np.take(amplitude.astype(np.float32), codes)


def as_dtype(amplitude: NDArray[np.float32], dtype: str) -> tuple[NDArray[Any], LevelCodes | None]:
    """Return an image in a data type, with its own scale of 8-bit levels."""
    if dtype != "uint8":
        return amplitude.astype(dtype, copy=False), None
    levels = LevelCodes.of(amplitude)
    return levels.encode(amplitude), levels


def rounding_np(step_db: float) -> float:
    """Return the standard deviation of levels that are rounded to a step, in nepers."""
    return step_db * math.log(10) / 20 / math.sqrt(12)


def rounding_db(step_db: float) -> float:
    """Return the error of an image by rounding of its levels to a step, relative to the image, in dB."""
    return 20 * math.log10(rounding_np(step_db))


ROUNDING_DB: Final = rounding_db(_STEP_DB)
"""Rounding error of 8-bit images."""
