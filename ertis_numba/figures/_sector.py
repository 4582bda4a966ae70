"""Sector: azimuth and range as a plan in metres."""

import math
from collections.abc import Callable
from typing import Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from ertis_numba.analysis.side_lobes import without_side_lobes
from ertis_numba.figures import _words
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._page import FigurePage, PageBox
from ertis_numba.figures._sampling import PIXELS, centres, join_ranges, polar_raster, thickened
from ertis_numba.figures.sector_grid import draw_grid
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import Fan, plan_m

__all__ = ["draw", "draw_into", "draw_on", "fan_of", "height_of"]

_SIDE_EMS, _ROOF_EMS, _FLOOR_EMS = 3.6, 3.0, 2.0  # what names take around the sector
_MIN_RATIO, _MAX_RATIO = 0.3, 0.95  # of height to width


def fan_of(image: Energyscape) -> Fan:
    """Return the sector that an image covers."""
    return Fan.of(image.azimuth_rad, image.elevation_rad, image.range_m)


def draw(canvas: Canvas, image: Energyscape, *, side_lobes: bool) -> Figure:
    """Draw an image; the maximum over elevations."""
    hidden = not (image.is_planar or side_lobes)
    image = without_side_lobes(image) if hidden else image
    page, (box,), side = canvas.lay_out(_words.of_image(image), [height_of(canvas, fan_of(image))], width_pt=720.0)
    title = "" if image.is_planar else _words.highest_over("elevation", hidden=hidden)
    return canvas.side(page, side, draw_into(canvas, page, box, image, title=title))


def height_of(canvas: Canvas, fan: Fan) -> Callable[[float], float]:
    """Return the function from the width of a sector to its height, both with the labels around it, in points."""
    left, right, bottom, top = fan.extent_m()
    ratio = min(_MAX_RATIO, max(_MIN_RATIO, (top - bottom) / (right - left)))
    em_pt = canvas.style.em_pt
    return lambda width_pt: (width_pt - 2 * _SIDE_EMS * em_pt) * ratio + (_ROOF_EMS + _FLOOR_EMS) * em_pt


def draw_into(canvas: Canvas, page: FigurePage, box: PageBox, image: Energyscape, *, title: str = "") -> AxesImage:
    """Draw an image as a sector with rings, rays and the reflectors."""
    fan, em_pt = fan_of(image), canvas.style.em_pt
    left, right, bottom, top = fan.extent_m()
    inner = box.inset(left=_SIDE_EMS * em_pt, right=_SIDE_EMS * em_pt, bottom=_FLOOR_EMS * em_pt, top=_ROOF_EMS * em_pt)
    axes = page.axes(inner.fitted((top - bottom) / (right - left)))
    page.caption(box, title)
    return _paint(canvas, axes, fan, image)


def draw_on(canvas: Canvas, axes: Axes, image: Energyscape, *, side_lobes: bool) -> None:
    """Draw an image on given axes, to scale; of several elevations the strongest."""
    image = image if image.is_planar or side_lobes else without_side_lobes(image)
    fan = fan_of(image)
    left, right, bottom, top = fan.extent_m()
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.apply_aspect()  # so that names are placed where they are drawn
    _paint(canvas, axes, fan, image, aspect="equal")


def _paint(
    canvas: Canvas, axes: Axes, fan: Fan, image: Energyscape, *, aspect: Literal["auto", "equal"] = "auto"
) -> AxesImage:
    """Draw the sector with rings, rays and reflectors, whatever the axes show otherwise."""
    extent = left, right, bottom, top = fan.extent_m()
    step_m = max(right - left, top - bottom) / PIXELS
    level_db = fan.strongest(canvas.level_db(image.amplitude))
    range_m, level_db = thickened(*join_ranges(image.range_m, level_db))
    raster = polar_raster(
        level_db, fan, range_m, right_m=centres(left, right, step_m), ahead_m=centres(bottom, top, step_m)
    )
    shown = canvas.show(axes, raster, extent=extent, aspect=aspect)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_axis_off()
    draw_grid(axes, canvas.style, fan, spare_m=step_m / 2)
    axes.plot(0, 0, "^", markersize=0.9 * canvas.style.em_pt, color=canvas.style.ink, clip_on=False)
    canvas.mark_peaks(axes, lambda peak: tuple(plan_m(math.radians(peak.azimuth_deg), peak.range_m)))
    return shown
