"""An image with elevations: a map of the directions, and a plan."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FuncFormatter, MultipleLocator
from numpy.typing import NDArray

from ertis_numba.analysis.side_lobes import without_side_lobes
from ertis_numba.figures import _sector, _words
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._page import FigurePage, PageBox
from ertis_numba.figures._sampling import PIXELS, sphere_raster
from ertis_numba.figures.style import minus
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import spacing_rad, unit_vectors, unrolled_rad

__all__ = ["draw", "draw_map", "draw_on"]

_LEFT_EMS, _RIGHT_EMS, _FLOOR_EMS, _ROOF_EMS = 4.6, 1.4, 4.0, 1.8  # what ticks and names take around the map
_MIN_RATIO, _MAX_RATIO = 0.1, 1.05
_X, _Y = "azimuth (°)", "elevation (°)"


def draw(canvas: Canvas, image: Energyscape, *, side_lobes: bool) -> Figure:
    """Draw the maximum over range as a map, and the maximum over elevation as a sector."""
    image = image if side_lobes else without_side_lobes(image)
    panels = [_Map(canvas, image).height, _sector.height_of(canvas, _sector.fan_of(image))]
    page, boxes, side = canvas.lay_out(_words.of_image(image), panels, width_pt=1008.0)
    _Map(canvas, image).draw_into(
        page,
        boxes[0],
        canvas.level_db(image.amplitude).max(axis=1),
        _words.highest_over("range", hidden=not side_lobes),
    )
    title = _words.highest_over("elevation", hidden=not side_lobes)
    shown = _sector.draw_into(canvas, page, boxes[1], image, title=title)
    return canvas.side(page, side, shown)


def draw_map(canvas: Canvas, image: Energyscape, *, side_lobes: bool) -> Figure:
    """Draw the maximum over range as a map."""
    hidden = not (image.is_planar or side_lobes)
    image = without_side_lobes(image) if hidden else image
    projection = _Map(canvas, image)
    page, (box,), side = canvas.lay_out(_words.of_image(image), [projection.height], width_pt=720.0)
    title = _words.highest_over("range", hidden=hidden)
    shown = projection.draw_into(page, box, canvas.level_db(image.amplitude).max(axis=1), title)
    return canvas.side(page, side, shown)


def draw_on(canvas: Canvas, axes: Axes, image: Energyscape, *, side_lobes: bool) -> None:
    """Draw the maximum over range as a map on given axes."""
    image = image if image.is_planar or side_lobes else without_side_lobes(image)
    width_pt = axes.get_window_extent().width * 72 / axes.figure.dpi
    _Map(canvas, image).paint(axes, canvas.level_db(image.amplitude).max(axis=1), width_pt)
    axes.set_xlabel(_X)
    axes.set_ylabel(_Y)


class _Map:
    """Azimuth, to the left, and elevation of an image, in degrees."""

    def __init__(self, canvas: Canvas, image: Energyscape) -> None:
        self._canvas, self._em_pt = canvas, canvas.style.em_pt
        self._directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
        half_deg = math.degrees(spacing_rad(self._directions)) / 2 if len(self._directions) > 1 else 1.0
        azimuth_deg = np.degrees(unrolled_rad(image.azimuth_rad, 3 * math.radians(half_deg)))
        elevation_deg = np.degrees(image.elevation_rad)
        self._west, self._east = float(azimuth_deg.max() + half_deg), float(azimuth_deg.min() - half_deg)
        if self._west - self._east > 360.0 - half_deg:  # all around
            self._west, self._east = 180.0, -180.0
        self._low = max(-90.0, float(elevation_deg.min() - half_deg))
        self._high = min(90.0, float(elevation_deg.max() + half_deg))
        ratio = (self._high - self._low) / (self._west - self._east)
        self._ratio = min(_MAX_RATIO, max(_MIN_RATIO, ratio))

    def height(self, width_pt: float) -> float:
        """Return the height for a width, both with the labels around the map, in points."""
        across_pt = width_pt - (_LEFT_EMS + _RIGHT_EMS) * self._em_pt
        return across_pt * self._ratio + (_FLOOR_EMS + _ROOF_EMS) * self._em_pt

    def draw_into(self, page: FigurePage, box: PageBox, level_db: NDArray[np.float32], title: str) -> AxesImage:
        """Draw the level of each direction."""
        em_pt = self._em_pt
        inner = box.inset(
            left=_LEFT_EMS * em_pt, right=_RIGHT_EMS * em_pt, bottom=_FLOOR_EMS * em_pt, top=_ROOF_EMS * em_pt
        )
        page.caption(PageBox(inner.left, box.bottom, inner.width, box.height), title)
        axes = page.axes(inner.fitted(self._ratio), x=_X, y=_Y)
        return self.paint(axes, level_db, inner.width)

    def paint(self, axes: Axes, level_db: NDArray[np.float32], width_pt: float) -> AxesImage:
        """Draw the level of each direction on axes of a width in points."""
        canvas = self._canvas
        west, east, low, high = self._west, self._east, self._low, self._high
        step_deg = max(west - east, high - low) / (PIXELS / 2)
        raster = sphere_raster(
            level_db,
            self._directions,
            azimuth_rad=np.radians(np.arange(west - step_deg / 2, east, -step_deg)),
            elevation_rad=np.radians(np.arange(low + step_deg / 2, high, step_deg)),
        )
        shown = canvas.show(axes, raster, extent=(west, east, low, high))
        axes.set_xlim(west, east)
        axes.set_ylim(low, high)
        self._ticks(axes, width_pt)
        canvas.grid(axes)
        canvas.mark_peaks(axes, lambda peak: (east + (peak.azimuth_deg - east) % 360.0, peak.elevation_deg))
        return shown

    def _ticks(self, axes: Axes, width_pt: float) -> None:
        spans = self._west - self._east, self._high - self._low
        spacing_deg = 15.0 if max(spans) < 100 else 30.0
        while spans[0] / spacing_deg * 3.5 * self._em_pt > width_pt:
            spacing_deg *= 2
        for axis, span in ((axes.xaxis, spans[0]), (axes.yaxis, spans[1])):
            axis.set_major_locator(MultipleLocator(spacing_deg if span > spacing_deg else max(1.0, round(span / 2))))
        axes.xaxis.set_major_formatter(FuncFormatter(_name))


def _name(azimuth_deg: float, _: object = None) -> str:
    """Return the name of a tick, as reflectors have azimuths: from -180 to 180."""
    return minus(f"{math.remainder(azimuth_deg, 360.0):g}")
