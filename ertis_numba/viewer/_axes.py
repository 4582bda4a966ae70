"""Axes of a picture of range and azimuth: coordinates, rings, rays and labels, drawn once."""

import io
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import IdentityTransform
from numpy.typing import NDArray

from ertis_numba.figures.sector_grid import draw_grid, part_names
from ertis_numba.figures.style import THEMES, minus
from ertis_numba.geometry import Fan, plan_m

__all__ = ["PAGE", "SIDE_PX", "STYLE", "Ink", "Place", "bare_axes", "draw_axes", "draw_text", "ink_of", "name_colours"]

STYLE: Final = THEMES["dark"]
"""Style of the pictures."""
PAGE: Final = tuple(bytes.fromhex(STYLE.page[1:]))
"""Background colour: red, green, blue."""
SIDE_PX: Final = 44
"""Margin at the sides of the sector, for labels."""

_DPI: Final = 100
_TEXT_PT: Final = 11.0
_ROOF_PX, _FLOOR_PX = 26, 66  # Margins above and below the sector: labels of rays; labels of rings, and the colour bar.
_SCALE_PX: Final = 10  # Height of the colour bar.
_RING_PX: Final = 36  # Minimum distance of rings, with room for their labels.
_MIN_RATIO, _MAX_RATIO = 0.25, 1.0  # Height of the sector relative to its width.


@dataclass(frozen=True, slots=True)
class Place:
    """Position of the sector in the picture."""

    sensor_px: tuple[float, float]  # (x, y) from the upper left corner; may lie outside
    scale_px_m: float
    width_px: int
    height_px: int
    box_px: tuple[int, int, int, int]  # (left, top, right, bottom) of the sector

    @classmethod
    def of(cls, fan: Fan, width_px: int) -> "Place":
        """Return the position of a sector in a picture of a given width."""
        return cls.within(fan.extent_m(fan.range_m[0]), width_px)

    @classmethod
    def within(cls, extent_m: tuple[float, float, float, float], width_px: int) -> "Place":
        """Return the position of an area, with limits to the right and ahead, in a picture of a given width."""
        west, east, low, high = extent_m
        inner_px = width_px - 2 * SIDE_PX
        scale_px_m = min(inner_px / (east - west), inner_px * _MAX_RATIO / (high - low))
        tall_px = max(inner_px * _MIN_RATIO, (high - low) * scale_px_m)
        middle_px = width_px / 2
        sensor_px = (
            middle_px - (west + east) / 2 * scale_px_m,
            _ROOF_PX + tall_px / 2 + (low + high) / 2 * scale_px_m,
        )
        height_px = _ROOF_PX + round(tall_px) + _FLOOR_PX
        box_px = (
            math.floor(sensor_px[0] + west * scale_px_m),
            math.floor(sensor_px[1] - high * scale_px_m),
            math.ceil(sensor_px[0] + east * scale_px_m),
            math.ceil(sensor_px[1] - low * scale_px_m),
        )
        return cls(sensor_px, scale_px_m, width_px, height_px, box_px)

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Extent of the sector, to the right of the sensor and ahead of it."""
        left, top, right, bottom = self.box_px
        (x, y), scale = self.sensor_px, self.scale_px_m
        return (left - x) / scale, (right - x) / scale, (y - bottom) / scale, (y - top) / scale

    def pixel_of(self, azimuth_deg: float, range_m: float) -> tuple[float, float]:
        """Return the pixel of a position, from the upper left corner: x to the right, y down."""
        right_m, ahead_m = plan_m(math.radians(azimuth_deg), range_m)
        return self.sensor_px[0] + right_m * self.scale_px_m, self.sensor_px[1] - ahead_m * self.scale_px_m

    def place_of(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Return azimuth in degrees and range in metres of a pixel; the inverse of `pixel_of`."""
        (x, y), scale = self.sensor_px, self.scale_px_m
        right_m, ahead_m = (x_px - x) / scale, (y - y_px) / scale
        return math.degrees(math.atan2(-right_m, ahead_m)), math.hypot(right_m, ahead_m)

    @property
    def scale_px(self) -> tuple[int, int, int, int]:
        """Left, right, top and bottom of the colour bar."""
        across_px = min(240, self.width_px - 2 * SIDE_PX)
        left = (self.width_px - across_px) // 2
        return left, left + across_px, self.height_px - 32, self.height_px - 32 + _SCALE_PX


@dataclass(frozen=True, slots=True, eq=False)
class Ink:
    """Overlay of a picture."""

    places: NDArray[np.intp]  # (drawn,) pixels of the flat picture
    colours: NDArray[np.float32]  # (drawn, 3)
    cover: NDArray[np.float32]  # (drawn, 1) opacity, 0 to 1

    def onto(self, flat: NDArray[np.uint8]) -> None:
        """Draw over a flat picture: (pixel, 3) uint8."""
        under = flat[self.places] * (1 - self.cover)
        flat[self.places] = (under + self.colours * self.cover + 0.5).astype(np.uint8)


@STYLE.applied()
def draw_axes(place: Place, fan: Fan, dynamic_range_db: float) -> Ink:
    """Draw rings in metres, rays in degrees, the sensor, and the numbers of the colour bar."""
    (x, y), scale = place.sensor_px, place.scale_px_m
    figure, axes = bare_axes(place)
    (low_m, high_m), half_m = fan.range_m, 0.5 / scale
    rings = max(1, min(6, int((high_m - low_m) * scale / _RING_PX)))
    draw_grid(axes, STYLE, fan, first_m=low_m, largest=rings, spare_m=half_m)
    part_names(axes)
    if 0 <= x <= place.width_px and 0 <= y <= place.height_px - _FLOOR_PX + 1:
        axes.plot(0, 0, marker="^", markersize=8, color=STYLE.ink, scalex=False, scaley=False)
    name_colours(axes, place, (-dynamic_range_db, 0.0), "dB")
    return ink_of(figure)


@STYLE.applied()
def draw_text(place: Place, text: str) -> Ink:
    """Draw a text in the middle of an empty picture."""
    figure, _ = bare_axes(place)
    figure.text(0.5, 0.5, text, fontsize=_TEXT_PT, ha="center", va="center")
    return ink_of(figure)


def bare_axes(place: Place) -> tuple[Figure, Axes]:
    """Return a picture with undrawn axes that fill it, in the coordinates of the sector."""
    (x, y), scale = place.sensor_px, place.scale_px_m
    figure = Figure(figsize=(place.width_px / _DPI, place.height_px / _DPI), dpi=_DPI)
    axes = figure.add_axes((0, 0, 1, 1), frameon=False)
    axes.set_xlim(-x / scale, (place.width_px - x) / scale)
    axes.set_ylim((y - place.height_px) / scale, y / scale)
    axes.set_axis_off()
    return figure, axes


def name_colours(axes: Axes, place: Place, limits_db: tuple[float, float], unit: str) -> None:
    """Write the levels of the colour bar, and their unit."""
    (low_db, high_db), (left, right, top, bottom) = limits_db, place.scale_px
    pixels = IdentityTransform()  # From the lower left corner.
    for share in (0.0, 0.5, 1.0):
        name, name_px = minus(f"{low_db + share * (high_db - low_db) + 0.0:g}"), left + share * (right - left)
        axes.text(name_px, place.height_px - bottom - 3, name, ha="center", va="top", transform=pixels)
    axes.text(right + 14, place.height_px - (top + bottom) / 2, unit, va="center", transform=pixels)


def ink_of(figure: Figure) -> Ink:
    """Return a picture as an overlay."""
    file = io.BytesIO()
    figure.savefig(file, format="rgba", dpi=_DPI, transparent=True)
    drawn = np.frombuffer(file.getvalue(), np.uint8).reshape(-1, 4)
    places = np.flatnonzero(drawn[:, 3])
    cover = drawn[places, 3:].astype(np.float32) / np.float32(255)
    return Ink(places, drawn[places, :3].astype(np.float32), cover)
