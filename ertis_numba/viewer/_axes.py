"""Axes of a picture of range and azimuth: coordinates, rings, rays and labels, drawn once."""

import io
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.transforms import BboxBase

__all__ = ["PAGE", "SIDE_PX", "Ink", "Place", "draw_axes", "draw_text"]

PAGE: Final = (11, 13, 18)
"""Background colour: red, green, blue."""
SIDE_PX: Final = 44
"""Margin at the sides of the sector, for labels."""

_FAINT: Final = "#9aa0b0"
_DPI: Final = 100
_LETTERS: Final[dict[str, Any]] = {"color": _FAINT, "fontsize": 8.5}
_LINE: Final[dict[str, Any]] = {"color": _FAINT, "alpha": 0.4, "linewidth": 0.7}
_TEXT_PT: Final = 11.0
_ROOF_PX, _FLOOR_PX = 26, 66  # Margins above and below the sector: labels of rays; labels of rings, and the colour bar.
_SCALE_PX: Final = 10  # Height of the colour bar.
_RING_PX: Final = 36  # Minimum distance of rings, with room for their labels.
_APART_PX: Final = 2  # Minimum distance of labels.
_MIN_RATIO, _MAX_RATIO = 0.25, 1.0  # Height of the sector relative to its width.


@dataclass(frozen=True, slots=True)
class Place:
    """Position of the sector in the picture.

    Attributes
    ----------
    sensor_px : (x, y)
        Position of the sensor from the upper left corner of the picture; it may lie outside.
    scale_px_m : float
        Pixels per metre.
    width_px, height_px : int
        Size of the picture.
    box_px : (left, top, right, bottom)
        Bounds of the sector.
    """

    sensor_px: tuple[float, float]
    scale_px_m: float
    width_px: int
    height_px: int
    box_px: tuple[int, int, int, int]

    @classmethod
    def of(cls, azimuth_rad: NDArray[np.float64], range_m: tuple[float, float], width_px: int) -> "Place":
        """Return the position of a sector in a picture of a given width."""
        arc = np.linspace(azimuth_rad[0], azimuth_rad[-1], 361)
        right_m = -np.outer(range_m, np.sin(arc))
        ahead_m = np.outer(range_m, np.cos(arc))
        west, east = float(right_m.min()), float(right_m.max())
        low, high = float(ahead_m.min()), float(ahead_m.max())
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
        (x, y), scale = self.sensor_px, self.scale_px_m
        azimuth_rad = math.radians(azimuth_deg)
        return x - range_m * math.sin(azimuth_rad) * scale, y - range_m * math.cos(azimuth_rad) * scale

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
    """Overlay of a picture.

    Attributes
    ----------
    places : (drawn,) intp
        Pixels of the flat picture.
    colours : (drawn, 3) float32
    cover : (drawn, 1) float32
        Opacity of each pixel, 0 to 1.
    """

    places: NDArray[np.intp]
    colours: NDArray[np.float32]
    cover: NDArray[np.float32]

    def onto(self, flat: NDArray[np.uint8]) -> None:
        """Draw over a flat picture: (pixel, 3) uint8."""
        under = flat[self.places] * (1 - self.cover)
        flat[self.places] = (under + self.colours * self.cover + 0.5).astype(np.uint8)


def draw_axes(place: Place, fan_rad: NDArray[np.float64], range_m: tuple[float, float], dynamic_range_db: float) -> Ink:
    """Draw rings in metres, rays in degrees, the sensor, and the numbers of the colour bar.

    Parameters
    ----------
    place : Place
    fan_rad : (azimuth,) float64
        Rising.
    range_m : (first, last)
    dynamic_range_db : float
    """
    figure, axes = _sheet(place)
    first_deg, last_deg = math.degrees(fan_rad[0]), math.degrees(fan_rad[-1])
    _draw_rings(axes, place, first_deg, last_deg, range_m)
    _draw_rays(axes, place, first_deg, last_deg, range_m)
    x, y = place.sensor_px
    if 0 <= x <= place.width_px and 0 <= y <= place.height_px - _FLOOR_PX + 1:
        axes.plot(x, y, marker="^", markersize=8, color="#e8eaf0")
    left, right, _, bottom = place.scale_px
    for share in (0.0, 0.5, 1.0):
        name = f"{-dynamic_range_db * (1 - share):g}".replace("-", "−").replace("−0", "0")
        axes.text(left + share * (right - left), bottom + 3, name, ha="center", va="top", **_LETTERS)
    axes.text(right + 14, bottom - _SCALE_PX / 2, "dB", ha="left", va="center", **_LETTERS)
    return _ink(figure)


def _draw_rings(axes: Axes, place: Place, first_deg: float, last_deg: float, range_m: tuple[float, float]) -> None:
    """Draw rings with their labels, except overlapping ones: in a narrow window the labels have many digits."""
    arc_deg = np.linspace(first_deg, last_deg, 181)
    named_deg = first_deg if last_deg - first_deg < 350 else -135  # No ray has its label there.
    level = abs(first_deg + 90) < 20  # The labels of rings then stand below the edge, otherwise beside it.
    (low_m, high_m), half_m = range_m, 0.5 / place.scale_px_m
    rings = max(1, min(6, int((high_m - low_m) * place.scale_px_m / _RING_PX)))
    named: list[BboxBase] = []
    for ring_m in MaxNLocator(nbins=rings, steps=[1, 2, 5, 10]).tick_values(low_m, high_m):
        if not low_m - half_m <= ring_m <= high_m + half_m or ring_m <= 0:
            continue
        axes.plot(*np.array([place.pixel_of(at, ring_m) for at in arc_deg]).T, **_LINE)
        x, y = place.pixel_of(named_deg, ring_m)
        at_px = (x, y + 5) if level else (x + 6, y + 4)
        name = axes.text(*at_px, f"{ring_m:g} m", ha="center" if level else "left", va="top", **_LETTERS)
        name.set_x(at_px[0] - max(0.0, name.get_window_extent().x1 - place.width_px))
        box = name.get_window_extent().padded(_APART_PX)
        if any(box.overlaps(other) for other in named):
            name.remove()
        else:
            named.append(box)


def _draw_rays(axes: Axes, place: Place, first_deg: float, last_deg: float, range_m: tuple[float, float]) -> None:
    """Draw rays with their labels."""
    step_deg = 15 if last_deg - first_deg < 100 else 30
    first, last = math.ceil((first_deg - 1e-6) / step_deg), math.floor((last_deg + 1e-6) / step_deg)
    for ray_deg in sorted({180 - (180 - number * step_deg) % 360 for number in range(first, last + 1)}):
        axes.plot(*np.array([place.pixel_of(ray_deg, at_m) for at_m in range_m]).T, **_LINE)
        x, y = place.pixel_of(ray_deg, range_m[1] + 4 / place.scale_px_m)
        across = -math.sin(math.radians(ray_deg))
        side = "center" if abs(across) < 0.3 else "left" if across > 0 else "right"
        below = "top" if math.cos(math.radians(ray_deg)) < -0.3 else "bottom"
        axes.text(x, y, f"{ray_deg:+d}°".replace("-", "−").replace("+0", "0"), ha=side, va=below, **_LETTERS)


def draw_text(place: Place, text: str) -> Ink:
    """Draw a text in the middle of an empty picture."""
    figure, axes = _sheet(place)
    at_px = place.width_px / 2, place.height_px / 2
    axes.text(*at_px, text, color=_FAINT, fontsize=_TEXT_PT, ha="center", va="center", parse_math=False)
    return _ink(figure)


def _sheet(place: Place) -> tuple[Figure, Axes]:
    """Return the drawing surface, in pixels from the upper left corner."""
    figure = Figure(figsize=(place.width_px / _DPI, place.height_px / _DPI), dpi=_DPI)
    axes = figure.add_axes((0, 0, 1, 1), frameon=False)
    axes.set_xlim(0, place.width_px)
    axes.set_ylim(place.height_px, 0)
    axes.set_axis_off()
    return figure, axes


def _ink(figure: Figure) -> Ink:
    file = io.BytesIO()
    figure.savefig(file, format="rgba", dpi=_DPI, transparent=True)
    drawn = np.frombuffer(file.getvalue(), np.uint8).reshape(-1, 4)
    places = np.flatnonzero(drawn[:, 3])
    cover = drawn[places, 3:].astype(np.float32) / np.float32(255)
    return Ink(places, drawn[places, :3].astype(np.float32), cover)
