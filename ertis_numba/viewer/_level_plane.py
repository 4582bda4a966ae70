"""Picture of levels over direction: a plane of azimuth and elevation, or a polar plot for directions in a plane."""

import math
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from ertis_numba.figures.style import angle, minus
from ertis_numba.geometry import Fan, plan_m, round_step, spacing_rad, unit_vectors
from ertis_numba.viewer._axes import PAGE, STYLE, Ink, Place, bare_axes, draw_text, ink_of, name_colours
from ertis_numba.viewer._polar import PolarSampling
from ertis_numba.viewer._shapes import LevelScale

__all__ = ["LevelPlane"]

_REACH: Final = 1.3  # Distance from a direction up to which it is drawn, relative to the usual spacing.
_LINES: Final = 5  # Largest number of parts between rings.
_BEYOND: Final = 96  # Opacity of a polar plot beyond its levels.
_MARK_PX: Final = (5.0, 6.5)  # Radii of the ring around the loudest direction.
_MAX_INKS: Final = 8
_THIN: Final = 2  # Pixels of a picture per pixel of a polar plot on the platform, along each axis.
_GRID: Final[dict[str, Any]] = {
    "color": STYLE.faint,
    "alpha": 0.35,
    "linewidth": 0.7 * STYLE.line_pt,
    "scalex": False,
    "scaley": False,
}


class LevelPlane:
    """Renderer of the levels of the same directions (direction,), in pictures of a width in pixels."""

    # Several elevations have a plane of azimuth and elevation; directions in a horizontal plane a polar plot.

    def __init__(
        self, azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64], *, width_px: int = 520
    ) -> None:
        self._azimuth_rad, self._elevation_rad = azimuth_rad, elevation_rad
        self._directions = unit_vectors(azimuth_rad, elevation_rad)
        self.spacing_rad = spacing_rad(self._directions)
        self._fan: Fan | None = None
        if np.any(elevation_rad):
            half_rad = min(self.spacing_rad, 0.1) / 2
            self._extent = (
                float(-azimuth_rad.max() - half_rad),
                float(-azimuth_rad.min() + half_rad),
                max(float(elevation_rad.min() - half_rad), -math.pi / 2),
                min(float(elevation_rad.max() + half_rad), math.pi / 2),
            )
        else:
            self._fan = Fan.of(azimuth_rad, elevation_rad, np.array([0.0, 1.0]))
            self._extent = self._fan.extent_m()
        self._place = Place.within(self._extent, width_px)
        rows, columns = self.shape
        (x, y), scale = self._place.sensor_px, self._place.scale_px_m
        right = np.tile((np.arange(columns) + 0.5 - x) / scale, rows)
        ahead = np.repeat((y - np.arange(rows) - 0.5) / scale, columns)
        self._sampling = self._near(right, ahead) if self._fan is None else self._along(self._fan, right, ahead)
        # The radius of a polar plot, as a level; a plane shows all levels.
        radius = np.hypot(right, ahead)[self._sampling.places] if self._fan is not None else np.zeros(1)
        self._least = np.asarray(np.rint(255 * radius), np.uint8)
        self._page = np.full((rows, columns, 3), PAGE, dtype=np.uint8)
        self._box, self._kept, self._kept_places = self._thinned()
        self._inks: dict[tuple[float, float, str], Ink] = {}

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of `picture`."""
        return self._place.height_px, self._place.width_px

    @property
    def is_planar(self) -> bool:
        """True for a polar plot."""
        return self._fan is not None

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Limits of a polar plot with radius 1, to the right of the sensor and ahead of it."""
        return self._place.extent_m

    def pixel_of(self, direction: int, shade: int = 255) -> tuple[float, float]:
        """Return the pixel of a direction, with its level in a polar plot: x to the right, y down."""
        azimuth_rad, elevation_rad = float(self._azimuth_rad[direction]), float(self._elevation_rad[direction])
        right, ahead = (-azimuth_rad, elevation_rad) if self._fan is None else plan_m(azimuth_rad, shade / 255)
        (x, y), scale = self._place.sensor_px, self._place.scale_px_m
        return x + float(right) * scale, y - float(ahead) * scale

    def picture(self, shades: NDArray[np.uint8], table: NDArray[np.uint8], scale: LevelScale) -> NDArray[np.uint8]:
        """Return the picture with axes and a ring around the loudest direction: (row, column, 3)."""
        # `shades` (direction,) come from `LevelScale.shade`, and `table` (256, 3) has the colours of levels.
        made = self._page.copy()
        flat = made.reshape(-1, 3)
        flat[self._sampling.places] = table[self._shown(shades)]
        left, right, top, bottom = self._place.scale_px
        made[top:bottom, left:right] = table[np.linspace(0, 255, right - left).astype(np.uint8)]
        self._ink(scale).onto(flat)
        loudest = int(shades.argmax())
        if shades[loudest]:
            _mark(made, *self.pixel_of(loudest, int(shades[loudest])))
        return made

    def empty(self, text: str) -> NDArray[np.uint8]:
        """Return an empty picture with a text: (row, column, 3) uint8."""
        made = self._page.copy()
        draw_text(self._place, text).onto(made.reshape(-1, 3))
        return made

    def sector(self, shades: NDArray[np.uint8], table: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a polar plot alone, translucent beyond its levels: (row, column, 4) uint8, one pixel of two."""
        made = np.zeros((*self._box, 4), dtype=np.uint8)
        flat, shown = made.reshape(-1, 4), self._shown(shades)[self._kept]
        flat[self._kept_places, :3] = table[shown]
        flat[self._kept_places, 3] = np.where(shown, 255, _BEYOND)
        return made

    def _shown(self, shades: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the colour of each drawn point: 0 beyond the level of a polar plot."""
        shade = self._sampling(shades if self._fan is None else self._fan.strongest(shades))
        return np.where(shade >= self._least, shade, np.uint8(0))

    def _thinned(self) -> tuple[tuple[int, int], NDArray[np.intp], NDArray[np.intp]]:
        """Return the shape of `sector`, the drawn points in it, and their places there."""
        left, top, right, bottom = self._place.box_px
        shape = (math.ceil((bottom - top) / _THIN), math.ceil((right - left) / _THIN))
        row, column = np.divmod(self._sampling.places, self.shape[1])
        row, column = row - top, column - left
        inside = (row >= 0) & (row < bottom - top) & (column >= 0) & (column < right - left)
        kept = np.flatnonzero(inside & (row % _THIN == 0) & (column % _THIN == 0))
        return shape, kept, row[kept] // _THIN * shape[1] + column[kept] // _THIN

    def _near(self, right: NDArray[np.float64], ahead: NDArray[np.float64]) -> PolarSampling:
        """Return the direction nearest to each point of a plane."""
        # Importing SciPy's trees takes a tenth of a second, and images do not need them.
        from scipy.spatial import KDTree  # noqa: PLC0415

        west, east, low, high = self._extent
        places = np.flatnonzero((right >= west) & (right <= east) & (ahead >= low) & (ahead <= high))
        looks = unit_vectors(-right[places], ahead[places])
        away, nearest = KDTree(self._directions).query(looks)
        near = away <= 2 * math.sin(min(_REACH * self.spacing_rad, math.pi) / 2)
        nearest = nearest[near]
        return PolarSampling(places[near], nearest, nearest, np.zeros(len(nearest), np.uint16))

    @staticmethod
    def _along(fan: Fan, right: NDArray[np.float64], ahead: NDArray[np.float64]) -> PolarSampling:
        """Return the interpolation between the azimuths of a polar plot."""
        at, near = fan.directions(right, ahead)
        inside = near & (np.hypot(right, ahead) <= 1)
        before = np.floor(at[inside]).astype(np.intp)
        share = np.rint((at[inside] - before) * 256).astype(np.uint16)
        return PolarSampling(np.flatnonzero(inside), before, np.minimum(before + 1, len(fan.azimuth_rad) - 1), share)

    def _ink(self, scale: LevelScale) -> Ink:
        """Return the axes, which take some 30 ms; those of recent scales are kept."""
        key = (scale.low_db, scale.high_db, scale.unit)
        if key not in self._inks:
            if len(self._inks) >= _MAX_INKS:
                self._inks.clear()
            self._inks[key] = self._draw_axes(scale)
        return self._inks[key]

    @STYLE.applied()
    def _draw_axes(self, scale: LevelScale) -> Ink:
        figure, axes = bare_axes(self._place)
        name_colours(axes, self._place, (scale.low_db, scale.high_db), scale.unit)
        if self._fan is None:
            self._draw_box(axes)
        else:
            _draw_polar_grid(axes, self._fan, scale)
        return ink_of(figure)

    def _draw_box(self, axes: Axes) -> None:
        """Draw lines of azimuth and elevation, with their numbers."""
        west, east, low, high = self._extent
        for degrees in _round_deg(-east, -west):
            right = -math.radians(degrees)
            axes.plot([right, right], [low, high], **_GRID)
            _name(axes, angle(degrees), (right, low), (0, -4), ("center", "top"))
        for degrees in _round_deg(low, high):
            ahead = math.radians(degrees)
            axes.plot([west, east], [ahead, ahead], **_GRID)
            _name(axes, angle(degrees), (west, ahead), (-4, 0), ("right", "center"))


def _mark(made: NDArray[np.uint8], x: float, y: float) -> None:
    """Draw a ring."""
    top, left = max(0, int(y - _MARK_PX[1])), max(0, int(x - _MARK_PX[1]))
    part = made[top : int(y + _MARK_PX[1]) + 2, left : int(x + _MARK_PX[1]) + 2]
    rows, columns = np.ogrid[: part.shape[0], : part.shape[1]]
    away_px = np.hypot(columns + left + 0.5 - x, rows + top + 0.5 - y)
    part[(away_px >= _MARK_PX[0]) & (away_px <= _MARK_PX[1])] = 255


def _round_deg(first_rad: float, last_rad: float) -> list[int]:
    """Return round angles within limits, in degrees."""
    first_deg, last_deg = math.degrees(first_rad), math.degrees(last_rad)
    step_deg = 10 if last_deg - first_deg < 70 else 30
    first, last = math.ceil((first_deg - 1e-6) / step_deg), math.floor((last_deg + 1e-6) / step_deg)
    return [number * step_deg for number in range(first, last + 1)]


def _draw_polar_grid(axes: Axes, fan: Fan, scale: LevelScale) -> None:
    """Draw rays in degrees, and rings in decibels."""
    for ray_deg in fan.rays_deg():
        across, ahead = plan_m(math.radians(ray_deg), 1.0)
        axes.plot(*plan_m(math.radians(ray_deg), np.array([0.0, 1.0])), **_GRID)
        _name(
            axes, angle(math.remainder(ray_deg, 360)), (across, ahead), (14 * across, 9 * ahead), ("center", "center")
        )
    span_db, first_rad = scale.high_db - scale.low_db, float(fan.azimuth_rad[0])
    step_db = round_step(span_db, _LINES)
    for number in range(math.floor(span_db / step_db + 1e-9)):
        radius = 1 - number * step_db / span_db
        axes.plot(*plan_m(fan.arc_rad, radius), **_GRID)
        name = minus(f"{scale.high_db - number * step_db:g}")
        _name(axes, name, tuple(plan_m(first_rad, radius)), (0, -3), ("center", "top"))


def _name(
    axes: Axes, text: str, place: tuple[float, float], offset_pt: tuple[float, float], align: tuple[str, str]
) -> None:
    options: dict[str, Any] = {"textcoords": "offset points", "annotation_clip": False}
    axes.annotate(text, place, xytext=offset_pt, ha=align[0], va=align[1], **options)
