"""Picture of one sensor: range and azimuth, as a plan in metres whose axes are drawn once."""

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.levels import below_strongest_db
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import Fan
from ertis_numba.viewer._axes import PAGE, SIDE_PX, Ink, Place, draw_axes, draw_text

__all__ = ["Polar", "PolarSampling", "cropped", "is_within"]

_SHARES: Final = 256  # Steps of the interpolation between two directions.


def is_within(image: Energyscape, range_m: tuple[float, float] | None) -> bool:
    """Return True if a window contains any range of an image."""
    first_m, last_m = (-math.inf, math.inf) if range_m is None else range_m
    return bool(((image.range_m >= first_m - 1e-9) & (image.range_m <= last_m + 1e-9)).any())


def cropped(image: Energyscape, range_m: tuple[float, float] | None) -> Energyscape:
    """Return the part of an image within a window of the range axis; the nearest range for an empty one."""
    if range_m is None:
        return image
    first, last = np.searchsorted(image.range_m, [range_m[0] - 1e-9, range_m[1] + 1e-9])
    first = min(int(first), len(image.range_m) - 1)
    last = max(int(last), first + 1)
    if last - first == len(image.range_m):
        return image
    amplitude = np.ascontiguousarray(image.amplitude[:, first:last])
    return image.replace(amplitude=amplitude, range_m=image.range_m[first:last])


@dataclass(frozen=True, slots=True, eq=False)
class PolarSampling:
    """Interpolation of levels at points of a plane, between two levels of `Polar.levels`; arrays are (shown,)."""

    places: NDArray[np.intp]  # points within the image
    first: NDArray[np.intp]  # flat index
    second: NDArray[np.intp]  # flat index
    share: NDArray[np.uint16]  # weight of the second, of 256

    def __call__(self, levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the level of each point within the image: (shown,) uint8."""
        flat = levels.reshape(-1)
        first, second = flat[self.first].astype(np.uint16), flat[self.second].astype(np.uint16)
        weighed = first * (_SHARES - self.share) + second * self.share
        return np.asarray(weighed >> 8, dtype=np.uint8)


class Polar:
    """Renderer of images with the same axes.

    As x is forward and y left in the sensor frame, positive azimuth is on the left. For several elevations, the maximum
    is shown. Levels between two directions are interpolated, unless the directions are too far apart. Ranges finer than
    a pixel are joined to their maximum.

    Parameters
    ----------
    image : Energyscape
        Energyscape with the axes of the pictures; the complete range axis is shown.
    dynamic_range_db : float
    width_px : int
        Width of the pictures; the height follows from it.

    Raises
    ------
    ArgumentError
        The width is too small.
    """

    def __init__(self, image: Energyscape, *, dynamic_range_db: float = 40.0, width_px: int = 520) -> None:
        if width_px < 4 * SIDE_PX:
            raise ArgumentError(f"width_px is {width_px}; use at least {4 * SIDE_PX}")
        self._dynamic_range_db = dynamic_range_db
        if image.range_m[-1] <= 0:
            raise ArgumentError("the image ends at range 0; use an image with ranges")
        self._fan = Fan.of(image.azimuth_rad, image.elevation_rad, image.range_m)
        self._place = Place.of(self._fan, width_px)
        self._bins = self._joined_ranges(image.range_m)
        ends = np.append(self._bins[1:], len(image.range_m)) - 1
        self._bins_m = (image.range_m[self._bins] + image.range_m[ends]) / 2
        self._pixels = self._look_of_picture()

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Extent of `sector`, to the right of the sensor and ahead of it."""
        return self._place.extent_m

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of `picture`."""
        return self._place.height_px, self._place.width_px

    def pixel_of(self, azimuth_deg: float, range_m: float) -> tuple[float, float]:
        """Return the pixel of a position, from the upper left corner: x to the right, y down."""
        return self._place.pixel_of(azimuth_deg, range_m)

    def place_of(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Return azimuth in degrees and range in metres of a pixel; the inverse of `pixel_of`."""
        return self._place.place_of(x_px, y_px)

    def levels(self, amplitude: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the levels to draw: (azimuth, range) uint8, 255 for the strongest and 0 for none."""
        joined = np.maximum.reduceat(amplitude, self._bins, axis=1)
        level_db = below_strongest_db(self._fan.strongest(joined), self._dynamic_range_db)
        return np.asarray(np.rint(255 * (1 + level_db / self._dynamic_range_db)), dtype=np.uint8)

    def picture(self, levels: NDArray[np.uint8], table: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the picture with its axes.

        Parameters
        ----------
        levels : (azimuth, range) uint8
            Result of `levels`.
        table : (256, 3) uint8
            Colours of levels.

        Returns
        -------
        (row, column, 3) uint8
        """
        made = np.full((*self.shape, 3), PAGE, dtype=np.uint8)
        flat = made.reshape(-1, 3)
        flat[self._pixels.places] = table[self._pixels(levels)]
        left, right, top, bottom = self._place.scale_px
        made[top:bottom, left:right] = table[np.linspace(0, 255, right - left).astype(np.uint8)]
        self._axes.onto(flat)
        return made

    def empty(self, window_m: tuple[float, float] | None) -> NDArray[np.uint8]:
        """Return an empty picture with a note that the window contains no range: (row, column, 3) uint8."""
        made = np.full((*self.shape, 3), PAGE, dtype=np.uint8)
        (first_m, last_m), (low_m, high_m) = window_m or (0.0, 0.0), self._fan.range_m
        text = f"nothing from {first_m:g} to {last_m:g} m:\nthe image covers {low_m:.2f} to {high_m:.2f} m"
        draw_text(self._place, text).onto(made.reshape(-1, 3))
        return made

    @functools.cached_property
    def _axes(self) -> Ink:
        return draw_axes(self._place, self._fan, self._dynamic_range_db)

    def sector(self, levels: NDArray[np.uint8], table: NDArray[np.uint8], *, thin: int = 2) -> NDArray[np.uint8]:
        """Return the image alone, transparent outside: (row, column, 4) uint8, one pixel of ``thin``."""
        left, top, right, bottom = self._place.box_px
        made = np.zeros((*self.shape, 4), dtype=np.uint8)
        flat = made.reshape(-1, 4)
        flat[self._pixels.places, :3] = table[self._pixels(levels)]
        flat[self._pixels.places, 3] = 255
        return np.ascontiguousarray(made[top:bottom:thin, left:right:thin])

    def _joined_ranges(self, range_m: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return the first of each group of joined ranges, such that no line of sight has two pixels in a group."""
        if len(range_m) < 2:
            return np.zeros(1, dtype=np.intp)
        step_px = float(range_m[1] - range_m[0]) * self._place.scale_px_m
        return np.arange(0, len(range_m), max(1, math.floor(1 / step_px) if step_px < 1 else 1), dtype=np.intp)

    def look(self, right_m: NDArray[np.float64], ahead_m: NDArray[np.float64]) -> PolarSampling:
        """Return the interpolation for points in the sensor's plane.

        Parameters
        ----------
        right_m, ahead_m : (place,) float64
        """
        radius_m, half_m = np.hypot(right_m, ahead_m), 0.5 / self._place.scale_px_m
        first_m, last_m = self._fan.range_m
        at, near = self._fan.directions(right_m, ahead_m)
        inside = near & (radius_m >= first_m - half_m) & (radius_m <= last_m + half_m)
        before = np.floor(at[inside]).astype(np.intp)
        share = np.rint((at[inside] - before) * _SHARES).astype(np.uint16)
        after = np.minimum(before + 1, len(self._fan.azimuth_rad) - 1)
        bins, n_bins = np.searchsorted((self._bins_m[1:] + self._bins_m[:-1]) / 2, radius_m[inside]), len(self._bins_m)
        return PolarSampling(np.flatnonzero(inside), before * n_bins + bins, after * n_bins + bins, share)

    def _look_of_picture(self) -> PolarSampling:
        """Return the interpolation for the pixels of the picture."""
        rows, columns = self.shape
        (x, y), scale = self._place.sensor_px, self._place.scale_px_m
        right_m = (np.arange(columns) + 0.5 - x) / scale
        ahead_m = (y - np.arange(rows) - 0.5) / scale
        return self.look(np.tile(right_m, rows), np.repeat(ahead_m, columns))
