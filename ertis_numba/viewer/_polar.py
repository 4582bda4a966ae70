"""The picture of one sensor: range and azimuth, as a plan in metres whose axes are drawn once."""

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ertis_numba.errors import ArgumentError
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import unit_vectors
from ertis_numba.viewer._axes import PAGE, SIDE_PX, Ink, Place, draw_axes

__all__ = ["Look", "Polar", "cropped"]

_THIN_RAD: Final = math.radians(1.0)
_SHARES: Final = 256  # in which what lies between two directions is weighed


def cropped(image: Energyscape, range_m: tuple[float, float] | None) -> Energyscape:
    """Return the part of an image within a window of the range axis; of an empty one the nearest range."""
    if range_m is None:
        return image
    first, last = np.searchsorted(image.range_m, [range_m[0] - 1e-9, range_m[1] + 1e-9])
    first = min(int(first), len(image.range_m) - 1)
    last = max(int(last), first + 1)
    if last - first == len(image.range_m):
        return image
    energy = np.ascontiguousarray(image.energy[:, first:last])
    return image.replace(energy=energy, range_m=image.range_m[first:last])


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """Which directions and ranges some places of a plane show; called, it returns their levels.

    Attributes
    ----------
    places : (shown,) intp
        Which of the places see anything.
    first, second : (shown,) intp
        Of levels as `Polar.levels` returns them, flat: on either side of the place.
    share : (shown,) uint16
        Of the second, of 256.
    """

    places: NDArray[np.intp]
    first: NDArray[np.intp]
    second: NDArray[np.intp]
    share: NDArray[np.uint16]

    def __call__(self, levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the level of each place that sees anything: (shown,) uint8."""
        flat = levels.reshape(-1)
        first, second = flat[self.first].astype(np.uint16), flat[self.second].astype(np.uint16)
        weighed = first * (_SHARES - self.share) + second * self.share
        return np.asarray(weighed >> 8, dtype=np.uint8)


class Polar:
    """Makes pictures of images that have the axes of one.

    As x is forward and y left in the sensor frame, positive azimuth is on the left. Of several elevations the
    strongest is shown. Levels between two directions are interpolated; ranges finer than a pixel are joined to their
    maximum.

    Parameters
    ----------
    image : Energyscape
        Whose axes they have: all of the range axis is shown.
    dynamic_range_db : float
    width_px : int
        Of the pictures; their height follows.

    Raises
    ------
    ArgumentError
        The width is too small.
    """

    def __init__(self, image: Energyscape, *, dynamic_range_db: float = 40.0, width_px: int = 520) -> None:
        if width_px < 4 * SIDE_PX:
            raise ArgumentError(f"width_px is {width_px}; give at least {4 * SIDE_PX}")
        self._floor = np.float32(10 ** (-dynamic_range_db / 20))
        self._dynamic_range_db = dynamic_range_db
        azimuth_rad, self._order, self._starts = _columns(image)
        self._range_m = float(image.range_m[0]), float(image.range_m[-1])
        if self._range_m[1] <= 0:
            raise ArgumentError("the image ends at range 0; give one with ranges")
        self._fan_rad = azimuth_rad
        if azimuth_rad[-1] - azimuth_rad[0] < _THIN_RAD:  # too thin to be seen
            middle = float(azimuth_rad.mean())
            self._fan_rad = np.array([middle - _THIN_RAD, middle + _THIN_RAD])
        self._place = Place.of(self._fan_rad, self._range_m, width_px)
        self._bins = self._joined_ranges(image.range_m)
        ends = np.append(self._bins[1:], len(image.range_m)) - 1
        self._bins_m = (image.range_m[self._bins] + image.range_m[ends]) / 2
        self._pixels = self._look_of_picture()

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Where `sector` begins and ends to the right of the sensor and ahead of it."""
        return self._place.extent_m

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of `picture`."""
        return self._place.height_px, self._place.width_px

    def pixel_of(self, azimuth_deg: float, range_m: float) -> tuple[float, float]:
        """Return where a place is in the picture, in pixels from its upper left corner: x to the right, y down."""
        return self._place.pixel_of(azimuth_deg, range_m)

    def place_of(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Return azimuth in degrees and range in metres of a place in the picture; the inverse of `pixel_of`."""
        return self._place.place_of(x_px, y_px)

    def levels(self, energy: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the levels to draw: (azimuth, range) uint8, 255 the strongest and 0 silence."""
        joined = np.maximum.reduceat(energy, self._bins, axis=1)
        highest = np.maximum.reduceat(joined[self._order], self._starts, axis=0)
        strongest = np.float32(highest.max(initial=0.0)) or np.float32(1)
        level_db = 20 * np.log10(np.maximum(highest / strongest, self._floor))
        return np.rint(255 * (1 + level_db / self._dynamic_range_db)).astype(np.uint8)

    def picture(self, levels: NDArray[np.uint8], table: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the picture with its axes.

        Parameters
        ----------
        levels : (azimuth, range) uint8
            Of `levels`.
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

    @functools.cached_property
    def _axes(self) -> Ink:
        return draw_axes(self._place, self._fan_rad, self._range_m, self._dynamic_range_db)

    def sector(self, levels: NDArray[np.uint8], table: NDArray[np.uint8], *, thin: int = 2) -> NDArray[np.uint8]:
        """Return the image alone, transparent where there is none: (row, column, 4) uint8, one pixel of ``thin``."""
        left, top, right, bottom = self._place.box_px
        made = np.zeros((*self.shape, 4), dtype=np.uint8)
        flat = made.reshape(-1, 4)
        flat[self._pixels.places, :3] = table[self._pixels(levels)]
        flat[self._pixels.places, 3] = 255
        return np.ascontiguousarray(made[top:bottom:thin, left:right:thin])

    def _joined_ranges(self, range_m: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return where ranges that become one begin, such that no two pixels of a line of sight lie within one."""
        if len(range_m) < 2:
            return np.zeros(1, dtype=np.intp)
        step_px = float(range_m[1] - range_m[0]) * self._place.scale_px_m
        return np.arange(0, len(range_m), max(1, math.floor(1 / step_px) if step_px < 1 else 1), dtype=np.intp)

    def look(self, right_m: NDArray[np.float64], ahead_m: NDArray[np.float64]) -> Look:
        """Return which directions and ranges places in the sensor's plane show.

        Parameters
        ----------
        right_m, ahead_m : (place,) float64
        """
        radius_m = np.hypot(right_m, ahead_m)
        azimuth_rad = np.arctan2(-right_m, ahead_m)
        half_m = 0.5 / self._place.scale_px_m
        inside = (radius_m >= self._range_m[0] - half_m) & (radius_m <= self._range_m[1] + half_m)
        inside &= (azimuth_rad >= self._fan_rad[0] - 1e-9) & (azimuth_rad <= self._fan_rad[-1] + 1e-9)
        n_azimuths, n_bins = len(self._starts), len(self._bins_m)
        at = np.interp(azimuth_rad[inside], self._fan_rad, np.linspace(0, n_azimuths - 1, len(self._fan_rad)))
        before = np.floor(at).astype(np.intp)
        after = np.minimum(before + 1, n_azimuths - 1)
        bins = np.searchsorted((self._bins_m[1:] + self._bins_m[:-1]) / 2, radius_m[inside])
        return Look(
            np.flatnonzero(inside),
            before * n_bins + bins,
            after * n_bins + bins,
            np.rint((at - before) * _SHARES).astype(np.uint16),
        )

    def _look_of_picture(self) -> Look:
        """Return which directions and ranges each pixel of the picture shows."""
        rows, columns = self.shape
        (x, y), scale = self._place.sensor_px, self._place.scale_px_m
        right_m = (np.arange(columns) + 0.5 - x) / scale
        ahead_m = (y - np.arange(rows) - 0.5) / scale
        return self.look(np.tile(right_m, rows), np.repeat(ahead_m, columns))


def _columns(image: Energyscape) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
    """Return rising azimuths, the order of the directions, and where those of each azimuth begin in it."""
    azimuth_rad = image.azimuth_rad
    if image.is_planar or len(azimuth_rad) == 1:
        order = np.argsort(azimuth_rad, kind="stable")
        return azimuth_rad[order], order, np.arange(len(order))
    directions = unit_vectors(azimuth_rad, image.elevation_rad)
    distance, _ = KDTree(directions).query(directions, k=2)
    step_rad = max(2 * math.asin(min(1.0, float(np.median(distance[:, 1])) / 2)), 1e-9)
    bins = np.rint((azimuth_rad - azimuth_rad.min()) / step_rad).astype(np.intp)
    order = np.argsort(bins, kind="stable")
    filled, starts = np.unique(bins[order], return_index=True)
    return azimuth_rad.min() + filled * step_rad, order, starts
