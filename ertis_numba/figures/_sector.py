"""Sector: azimuth and range as a plan in metres."""

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ertis_numba.analysis.side_lobes import without_side_lobes
from ertis_numba.figures import _words
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._page import FigurePage, PageBox
from ertis_numba.figures._sampling import PIXELS, centres, flattened, join_ranges, polar_raster, thickened
from ertis_numba.figures._style import text_width_pt
from ertis_numba.frames import Energyscape, Peak
from ertis_numba.geometry import ALONE_RAD

__all__ = ["draw", "draw_into", "draw_on", "height_of"]

_SIDE_EMS, _ROOF_EMS, _FLOOR_EMS = 3.6, 3.0, 2.0  # what names take around the sector
_MIN_RATIO, _MAX_RATIO = 0.3, 0.95  # of height to width


def draw(canvas: Canvas, image: Energyscape, *, side_lobes: bool) -> Figure:
    """Draw an image; the maximum over elevations."""
    hidden = not (image.is_planar or side_lobes)
    image = without_side_lobes(image) if hidden else image
    azimuth_rad, level_db = flattened(image, canvas.level_db(image.amplitude))
    page, (box,), side = canvas.lay_out(
        _words.of_image(image), [height_of(canvas, azimuth_rad, image.range_m)], width_pt=720.0
    )
    title = "" if image.is_planar else _words.highest_over("elevation", hidden=hidden)
    shown = draw_into(canvas, page, box, azimuth_rad, image.range_m, level_db, title=title)
    return canvas.side(page, side, shown)


def height_of(
    canvas: Canvas, azimuth_rad: NDArray[np.float64], range_m: NDArray[np.float64]
) -> Callable[[float], float]:
    """Return the function from the width of a sector to its height, both with the labels around it, in points."""
    left, right, bottom, top = _extent(_ends(azimuth_rad), range_m)
    ratio = min(_MAX_RATIO, max(_MIN_RATIO, (top - bottom) / (right - left)))
    em_pt = canvas.style.em_pt
    return lambda width_pt: (width_pt - 2 * _SIDE_EMS * em_pt) * ratio + (_ROOF_EMS + _FLOOR_EMS) * em_pt


def draw_into(
    canvas: Canvas,
    page: FigurePage,
    box: PageBox,
    azimuth_rad: NDArray[np.float64],
    range_m: NDArray[np.float64],
    level_db: NDArray[np.float32],
    *,
    title: str = "",
) -> AxesImage:
    """Draw levels (direction, range), of rising azimuths, as a sector with rings, rays and the reflectors."""
    left, right, bottom, top = _extent(_fan(azimuth_rad, level_db)[0], range_m)
    em_pt = canvas.style.em_pt
    inner = box.inset(left=_SIDE_EMS * em_pt, right=_SIDE_EMS * em_pt, bottom=_FLOOR_EMS * em_pt, top=_ROOF_EMS * em_pt)
    axes = page.axes(inner.fitted((top - bottom) / (right - left)))
    page.caption(box, title)
    return _paint(canvas, axes, azimuth_rad, range_m, level_db)


def draw_on(canvas: Canvas, axes: Axes, image: Energyscape, *, side_lobes: bool) -> None:
    """Draw an image on given axes, to scale; of several elevations the strongest."""
    image = image if image.is_planar or side_lobes else without_side_lobes(image)
    azimuth_rad, level_db = flattened(image, canvas.level_db(image.amplitude))
    left, right, bottom, top = _extent(_fan(azimuth_rad, level_db)[0], image.range_m)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.apply_aspect()  # so that names are placed where they are drawn
    _paint(canvas, axes, azimuth_rad, image.range_m, level_db, aspect="equal")


def _paint(
    canvas: Canvas,
    axes: Axes,
    azimuth_rad: NDArray[np.float64],
    range_m: NDArray[np.float64],
    level_db: NDArray[np.float32],
    *,
    aspect: Literal["auto", "equal"] = "auto",
) -> AxesImage:
    """Draw the sector with rings, rays and reflectors, whatever the axes show otherwise."""
    azimuth_rad, level_db = _fan(azimuth_rad, level_db)
    extent = _extent(azimuth_rad, range_m)
    left, right, bottom, top = extent
    step_m = max(right - left, top - bottom) / PIXELS
    rings_m, levels_db = thickened(*join_ranges(range_m, level_db))
    raster = polar_raster(
        levels_db,
        azimuth_rad,
        rings_m,
        left_m=-centres(left, right, step_m),
        ahead_m=centres(bottom, top, step_m),
    )
    shown = canvas.show(axes, raster, extent=extent, aspect=aspect)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_axis_off()
    _rings(canvas, axes, azimuth_rad, range_m, half_m=step_m / 2)
    _rays(canvas, axes, azimuth_rad, range_m)
    triangle: dict[str, Any] = {"marker": "^", "markersize": 0.9 * canvas.style.em_pt, "color": canvas.style.ink}
    axes.plot(0, 0, **triangle, clip_on=False, scalex=False, scaley=False)
    canvas.mark_peaks(axes, _place_of)
    return shown


def _place_of(peak: Peak) -> tuple[float, float]:
    return _place(math.radians(peak.azimuth_deg), peak.range_m)


def _fan(
    azimuth_rad: NDArray[np.float64], level_db: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the directions and levels to draw; a thin image becomes two degrees wide."""
    ends_rad = _ends(azimuth_rad)
    if ends_rad[0] == azimuth_rad[0]:
        return azimuth_rad, level_db
    return ends_rad, np.repeat(level_db.max(axis=0)[None], 2, axis=0)


def _ends(azimuth_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the first and the last azimuth to draw."""
    first, last = float(azimuth_rad.min()), float(azimuth_rad.max())
    if last - first < ALONE_RAD:
        return (first + last) / 2 + np.array([-ALONE_RAD, ALONE_RAD])
    return np.array([first, last])


def _place(azimuth_rad: float, range_m: float) -> tuple[float, float]:
    return -range_m * math.sin(azimuth_rad), range_m * math.cos(azimuth_rad)


def _extent(azimuth_rad: NDArray[np.float64], range_m: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of the sector and the sensor, in metres."""
    arc = np.linspace(azimuth_rad[0], azimuth_rad[-1], 361)
    across_m = [0.0, *(-range_m[-1] * np.sin(arc))]
    ahead_m = [0.0, *(range_m[-1] * np.cos(arc))]
    return float(min(across_m)), float(max(across_m)), float(min(ahead_m)), float(max(ahead_m))


def _rings(
    canvas: Canvas, axes: Axes, azimuth_rad: NDArray[np.float64], range_m: NDArray[np.float64], *, half_m: float
) -> None:
    """Draw rings and their labels, at ranges of the image or half a pixel off."""
    last_m, size_pt = range_m[-1], canvas.style.tick_pt
    arc = np.linspace(azimuth_rad[0], azimuth_rad[-1], 361)
    # Names stand beside the first edge, outside of the sector, or under or over it where that edge runs level.
    outwards = math.copysign(1.0, -math.cos(azimuth_rad[0]))
    level = abs(math.degrees(math.asin(math.cos(azimuth_rad[0])))) < 20
    if level:
        offset, align = (0.0, 1.4 * size_pt * math.copysign(1.0, math.sin(azimuth_rad[0]))), "center"
    else:
        offset, align = (0.8 * size_pt, 0.8 * size_pt * outwards), "left"
    ticks_m = MaxNLocator(nbins=6, steps=[1, 2, 5, 10]).tick_values(0.0, last_m)
    rings_m = [float(ring_m) for ring_m in ticks_m if 0 < ring_m <= last_m + half_m]
    names = [f"{ring_m:g} m" for ring_m in rings_m]
    widest_pt = max((text_width_pt(name, size_pt, canvas.style.font) for name in names), default=0.0) + 0.5 * size_pt
    (left_m, right_m), width_pt = axes.get_xlim(), axes.bbox.width * 72 / axes.figure.dpi
    every = math.ceil(widest_pt * (right_m - left_m) / (rings_m[0] * width_pt)) if level and names else 1
    for number, (ring_m, name) in enumerate(zip(rings_m, names, strict=True), 1):
        if ring_m >= range_m[0] - half_m:
            _line(canvas, axes, -ring_m * np.sin(arc), ring_m * np.cos(arc))
        if (len(names) - number) % every == 0:
            _name(canvas, axes, _place(azimuth_rad[0], ring_m), name, offset=offset, align=(align, "center"))


def _rays(canvas: Canvas, axes: Axes, azimuth_rad: NDArray[np.float64], range_m: NDArray[np.float64]) -> None:
    first_deg, last_deg = np.degrees(azimuth_rad[[0, -1]])
    spacing_deg = 15 if last_deg - first_deg < 100 else 30
    gap_pt = 0.5 * canvas.style.tick_pt
    first, last = math.ceil((first_deg - 1e-6) / spacing_deg), math.floor((last_deg + 1e-6) / spacing_deg)
    if (last - first) * spacing_deg == 360:  # the last is the first
        first += 1
    for ray_deg in range(first * spacing_deg, last * spacing_deg + 1, spacing_deg):
        ray = math.radians(ray_deg)
        across, ahead = _place(ray, 1.0)
        _line(canvas, axes, range_m[[0, -1]] * across, range_m[[0, -1]] * ahead)
        _name(
            canvas,
            axes,
            _place(ray, range_m[-1]),
            _words.angle(math.remainder(ray_deg, 360.0)),
            offset=(gap_pt * across, gap_pt * ahead),
            align=(_side(across, "right", "left"), _side(ahead, "top", "bottom")),
        )


def _side(towards: float, before: str, behind: str) -> str:
    """Return the side of a label on which it points outwards."""
    return "center" if abs(towards) < 0.3 else behind if towards > 0 else before


def _line(canvas: Canvas, axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    axes.plot(
        x,
        y,
        color=canvas.style.faint,
        alpha=0.35,
        linewidth=0.7 * canvas.style.line_pt,
        clip_on=False,
        scalex=False,
        scaley=False,
    )


def _name(
    canvas: Canvas,
    axes: Axes,
    place: tuple[float, float],
    text: str,
    *,
    offset: tuple[float, float],
    align: tuple[str, str],
) -> None:
    axes.annotate(
        text,
        place,
        xytext=offset,
        textcoords="offset points",
        color=canvas.style.faint,
        fontsize=canvas.style.tick_pt,
        family=canvas.style.font,
        ha=align[0],
        va=align[1],
        annotation_clip=False,
    )
