"""Choices that users make in the viewer, and the colours of levels."""

import functools
from dataclasses import dataclass
from typing import Final

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks

__all__ = [
    "COLOURS",
    "DYNAMIC_RANGE_DB",
    "LEVELS_DB",
    "LOWEST_THRESHOLD_DB",
    "MAX_DECAY_S",
    "Choices",
    "colour_table",
]

COLOURS: Final = ("inferno", "viridis", "cividis", "magma")
"""Perceptually uniform colour maps, by their names in Matplotlib."""

LOWEST_THRESHOLD_DB: Final = -60.0
"""Lowest level of points that can be shown."""

DYNAMIC_RANGE_DB: Final = (10.0, 80.0)
"""Minimum and maximum dynamic range of pictures."""

MAX_DECAY_S: Final = 10.0
"""Maximum persistence of points."""

LEVELS_DB: Final = (-160.0, 160.0)
"""Lowest and highest level that the brightest colour of acoustic maps can have."""

_DIM: Final = 0.35  # Remaining brightness of an overdue sensor.


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """Choices that users make in the viewer.

    Attributes
    ----------
    threshold_db : float
        Lowest level of shown points relative to the strongest of an image; at most 0.
    dynamic_range_db : float
        Levels below this, relative to the strongest, have the darkest colour.
    range_m : (first, last), optional
        Window of the range axis; all of it by default.
    decay_s : float
        Time in which points fade; 0 shows points of the latest image only.
    colours : {"inferno", "viridis", "cividis", "magma"}
    band_hz : float, optional
        Frequency of the band that acoustic maps show; the sum of all bands by default.
    max_level_db : float, optional
        Level of the brightest colour of acoustic maps, in dBFS or in dB re 20 µPa as the maps have it; by default that
        of the loudest direction, rounded up to 5 dB.

    Raises
    ------
    ArgumentError
        A number is out of its bounds, or the colour map is unknown.
    """

    threshold_db: float = -20.0
    dynamic_range_db: float = 40.0
    range_m: tuple[float, float] | None = None
    decay_s: float = 0.0
    colours: str = COLOURS[0]
    band_hz: float | None = None
    max_level_db: float | None = None

    def __post_init__(self) -> None:
        checks.between("threshold_db", self.threshold_db, LOWEST_THRESHOLD_DB, 0.0)
        checks.between("dynamic_range_db", self.dynamic_range_db, *DYNAMIC_RANGE_DB)
        if self.range_m is not None:
            checks.interval("range_m", self.range_m, 0.0, 10_000.0)
        checks.between("decay_s", self.decay_s, 0.0, MAX_DECAY_S)
        checks.choice("colours", self.colours, COLOURS)
        if self.band_hz is not None:
            checks.between("band_hz", self.band_hz, 1.0, 1e9)
        if self.max_level_db is not None:
            checks.between("max_level_db", self.max_level_db, *LEVELS_DB)


@functools.cache
def colour_table(colours: str, *, dim: bool = False) -> NDArray[np.uint8]:
    """Return the colours of a map, the lowest level first and dim for an overdue sensor: (256, 3) uint8."""
    table = np.asarray(mpl.colormaps[colours](np.arange(256), bytes=True)[:, :3], dtype=np.uint8)
    return np.asarray(table * _DIM, dtype=np.uint8) if dim else table
