"""Sector of azimuth and range that an image covers, as a plan in metres: positive azimuth is on the left."""

import math
from dataclasses import dataclass
from typing import Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba.geometry.azimuths import ALONE_RAD, is_closed, reach_rad, unrolled_rad
from ertis_numba.geometry.neighbours import AzimuthColumns, azimuth_columns

__all__ = ["Fan", "plan_m", "round_step"]

Level = TypeVar("Level", bound=np.generic)

_SAME_RAD = 1e-9  # between directions that are one
_MAX_RINGS = 30  # of a window without two round ranges at any usual step


def plan_m(azimuth_rad: ArrayLike, range_m: ArrayLike) -> NDArray[np.float64]:
    """Return the place of azimuth and range, to the right of the sensor and ahead of it."""
    azimuth_rad, range_m = np.asarray(azimuth_rad), np.asarray(range_m)
    return np.stack([-range_m * np.sin(azimuth_rad), range_m * np.cos(azimuth_rad)])


def round_step(length: float, largest: int) -> float:
    """Return the smallest step of 1, 2 or 5 times a power of ten that divides a length into at most so many parts."""
    smallest = length / largest * (1 - 1e-9)
    power = 10.0 ** math.floor(math.log10(smallest))
    return next(each * power for each in (1, 2, 5, 10) if each * power >= smallest)


@dataclass(frozen=True, slots=True, eq=False)
class Fan:
    """Sector that an image covers: ranges (first, last) and rising azimuths; several elevations show their maximum."""

    azimuth_rad: NDArray[np.float64]
    range_m: tuple[float, float]
    _columns: AzimuthColumns
    _reach_rad: NDArray[np.float64]

    @classmethod
    def of(
        cls, azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64], range_m: NDArray[np.float64]
    ) -> Self:
        """Return the sector of the axes of an image."""
        columns = azimuth_columns(unrolled_rad(azimuth_rad), elevation_rad)
        drawn_rad = columns.azimuth_rad
        if drawn_rad[-1] - drawn_rad[0] < ALONE_RAD:  # Too thin to be visible.
            drawn_rad = (drawn_rad[0] + drawn_rad[-1]) / 2 + np.array([-ALONE_RAD, ALONE_RAD])
        elif is_closed(drawn_rad):  # The gap between the last and the first direction is covered, too.
            drawn_rad = np.append(drawn_rad, drawn_rad[0] + 2 * math.pi)
        return cls(drawn_rad, (float(range_m[0]), float(range_m[-1])), columns, reach_rad(np.diff(drawn_rad)))

    def strongest(self, levels: NDArray[Level]) -> NDArray[Level]:
        """Return the maximum of levels (direction, ...) near each azimuth: (azimuth, ...)."""
        highest = self._columns.strongest(levels)
        if self.azimuth_rad[0] != self._columns.azimuth_rad[0]:
            return np.repeat(highest.max(axis=0)[None], 2, axis=0)
        return highest if len(highest) == len(self.azimuth_rad) else np.concatenate([highest, highest[:1]])

    def extent_m(self, first_m: float = 0.0) -> tuple[float, float, float, float]:
        """Return left, right, bottom and top of the sector from a range on; 0 includes the sensor."""
        right_m, ahead_m = plan_m(self.arc_rad, np.array([[first_m], [self.range_m[1]]]))
        return float(right_m.min()), float(right_m.max()), float(ahead_m.min()), float(ahead_m.max())

    @property
    def arc_rad(self) -> NDArray[np.float64]:
        """Azimuths of a smooth arc: (361,) float64."""
        return np.linspace(self.azimuth_rad[0], self.azimuth_rad[-1], 361)

    def directions(
        self, right_m: NDArray[np.float64], ahead_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the place of points along the azimuths, 0 for the first, and whether a direction is near."""
        first_rad = self.azimuth_rad[0] - _SAME_RAD
        look_rad = first_rad + (np.arctan2(-right_m, ahead_m) - first_rad) % (2 * math.pi)
        place = np.interp(look_rad, self.azimuth_rad, np.arange(len(self.azimuth_rad)))
        gap = np.minimum(place.astype(np.intp), len(self.azimuth_rad) - 2)
        away_rad = np.minimum(look_rad - self.azimuth_rad[gap], self.azimuth_rad[gap + 1] - look_rad)
        inside = look_rad <= self.azimuth_rad[-1] + _SAME_RAD
        return place, inside & (away_rad <= self._reach_rad[gap] + _SAME_RAD)

    def rings_m(self, first_m: float, *, largest: int, spare_m: float) -> list[float]:
        """Return round ranges from a range to the last one or a little more, about so many."""
        first_m, last_m = max(first_m, 0.0), self.range_m[1]
        rings_m = [last_m]
        if last_m - first_m <= spare_m:
            return rings_m
        for count in range(largest, _MAX_RINGS):
            step_m = round_step(last_m - first_m, count)
            first, last = math.ceil((first_m - spare_m) / step_m), math.floor((last_m + spare_m) / step_m)
            rings_m = [number * step_m for number in range(max(1, first), last + 1)]
            if len(rings_m) > 1:
                break
        return rings_m

    def rays_deg(self) -> list[int]:
        """Return round azimuths in degrees, rising; they may exceed 180."""
        first_deg, last_deg = np.degrees(self.azimuth_rad[[0, -1]])
        step_deg = 15 if last_deg - first_deg < 100 else 30
        first, last = math.ceil((first_deg - 1e-6) / step_deg), math.floor((last_deg + 1e-6) / step_deg)
        first += (last - first) * step_deg == 360  # The last is the first.
        return [number * step_deg for number in range(first, last + 1)]
