"""The sector: azimuth and range as a plan in metres."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from ertis_numba.figures._canvas import Canvas, angle
from ertis_numba.figures._sampling import PIXELS, join_ranges, polar_raster
from ertis_numba.frames import Energyscape

__all__ = ["draw", "draw_into"]


def draw(canvas: Canvas, image: Energyscape) -> Figure:
    """Draw a planar image."""
    left, right, bottom, top = _extent(np.sort(image.azimuth_rad), image.range_m)
    height_in = 1.7 + 6.2 * min(0.9, max(0.3, (top - bottom) / (right - left or 1.0)))
    figure = canvas.figure(image, width_in=10.0, height_in=height_in)
    axes = figure.add_axes((0.02, 0.02, 0.74, 1 - 0.85 / height_in))
    shown = draw_into(canvas, axes, image.azimuth_rad, image.range_m, canvas.level_db(image.energy))
    canvas.side(figure, shown, left=0.775)
    return figure


def draw_into(
    canvas: Canvas,
    axes: Axes,
    azimuth_rad: NDArray[np.float64],
    range_m: NDArray[np.float64],
    level_db: NDArray[np.float32],
) -> AxesImage:
    """Draw levels (direction, range) as a sector with rings, rays and the reflectors."""
    order = np.argsort(azimuth_rad, kind="stable")
    azimuth_rad, level_db = _fan(azimuth_rad[order], level_db[order])
    extent = _extent(azimuth_rad, range_m)
    left, right, bottom, top = extent
    step_m = max(right - left, top - bottom) / PIXELS
    rings_m, levels_db = join_ranges(range_m, level_db)
    raster = polar_raster(
        levels_db,
        azimuth_rad,
        rings_m,
        left_m=-_centres(left, right, step_m),
        ahead_m=_centres(bottom, top, step_m),
    )
    shown = canvas.show(axes, raster, extent=extent)
    _rings(canvas, axes, azimuth_rad, range_m)
    _rays(canvas, axes, azimuth_rad, range_m)
    axes.plot(0, 0, marker="^", markersize=8, color=canvas.theme.ink)
    canvas.mark_peaks(axes, lambda peak: _place(math.radians(peak.azimuth_deg), peak.range_m))
    margin_m = 0.08 * range_m[-1]
    axes.set_xlim(left - margin_m, right + margin_m)
    axes.set_ylim(bottom - margin_m, top + margin_m)
    axes.set_axis_off()
    return shown


def _fan(
    azimuth_rad: NDArray[np.float64], level_db: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the directions and levels to draw: what is too thin to be seen becomes two degrees wide."""
    middle, half_rad = (azimuth_rad[0] + azimuth_rad[-1]) / 2, math.radians(1.0)
    if azimuth_rad[-1] - azimuth_rad[0] >= half_rad:
        return azimuth_rad, level_db
    return np.array([middle - half_rad, middle + half_rad]), np.repeat(level_db.max(axis=0)[None], 2, axis=0)


def _place(azimuth_rad: float, range_m: float) -> tuple[float, float]:
    return -range_m * math.sin(azimuth_rad), range_m * math.cos(azimuth_rad)


def _centres(first: float, last: float, step: float) -> NDArray[np.float64]:
    count = max(1, round((last - first) / step))
    return first + (np.arange(count) + 0.5) * (last - first) / count


def _extent(azimuth_rad: NDArray[np.float64], range_m: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top of the sector and the sensor, in metres."""
    arc = np.linspace(azimuth_rad[0], azimuth_rad[-1], 361)
    across_m = [0.0, *(-range_m[-1] * np.sin(arc))]
    ahead_m = [0.0, *(range_m[-1] * np.cos(arc))]
    return float(min(across_m)), float(max(across_m)), float(min(ahead_m)), float(max(ahead_m))


def _rings(canvas: Canvas, axes: Axes, azimuth_rad: NDArray[np.float64], range_m: NDArray[np.float64]) -> None:
    last_m = range_m[-1]
    arc = np.linspace(azimuth_rad[0], azimuth_rad[-1], 361)
    # Names stand beside the eastern edge, or under it where that edge runs level.
    level = abs(math.degrees(azimuth_rad[0]) + 90) < 20
    offset, align = ((0, -9), "center") if level else ((7, -4), "left")
    for ring_m in MaxNLocator(nbins=6, steps=[1, 2, 5, 10]).tick_values(0.0, last_m):
        if not 0 < ring_m <= last_m * (1 + 1e-9):
            continue
        if ring_m >= range_m[0]:
            _line(canvas, axes, -ring_m * np.sin(arc), ring_m * np.cos(arc))
        _name(canvas, axes, azimuth_rad[0], ring_m, f"{ring_m:g} m", offset=offset, align=align)


def _rays(canvas: Canvas, axes: Axes, azimuth_rad: NDArray[np.float64], range_m: NDArray[np.float64]) -> None:
    first_deg, last_deg = np.degrees(azimuth_rad[[0, -1]])
    spacing_deg = 15 if last_deg - first_deg < 100 else 30
    for ray_deg in range(-180, 181, spacing_deg):
        if not first_deg - 1e-6 <= ray_deg <= last_deg + 1e-6:
            continue
        ray = math.radians(ray_deg)
        ends_m = range_m[[0, -1]]
        _line(canvas, axes, -ends_m * math.sin(ray), ends_m * math.cos(ray))
        _name(canvas, axes, ray, range_m[-1] * 1.045, angle(ray_deg))


def _line(canvas: Canvas, axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    axes.plot(x, y, color=canvas.theme.faint, alpha=0.35, linewidth=0.7)


def _name(
    canvas: Canvas,
    axes: Axes,
    azimuth_rad: float,
    range_m: float,
    text: str,
    *,
    offset: tuple[int, int] = (0, 0),
    align: str = "center",
) -> None:
    axes.annotate(
        text,
        _place(azimuth_rad, range_m),
        xytext=offset,
        textcoords="offset points",
        color=canvas.theme.faint,
        fontsize=8.5,
        ha=align,
        va="center",
    )
