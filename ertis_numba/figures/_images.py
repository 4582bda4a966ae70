"""Pictures of an image: a sector in metres, a map of azimuth and elevation, or a curve over range."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.ticker import FuncFormatter, MultipleLocator
from numpy.typing import NDArray

from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._captions import highest_over
from ertis_numba.figures._page import Panel
from ertis_numba.figures._sampling import PIXELS, centres, join_ranges, polar_raster, sphere_raster, thickened
from ertis_numba.figures.sector_grid import draw_grid, part_names
from ertis_numba.figures.style import minus
from ertis_numba.frames import Energyscape, Peak
from ertis_numba.geometry import Fan, plan_m, spacing_rad, unit_vectors, unrolled_rad

__all__ = ["curve", "direction_map", "level_map", "sector"]

_SECTOR_RATIOS, _MAP_RATIOS = (0.3, 0.95), (0.1, 1.05)  # limits of height to width
_CURVE_RATIO = 0.42


def sector(canvas: Canvas, image: Energyscape, *, hidden: bool = False) -> Panel:
    """Return the maximum over elevation as a sector with rings and rays; side lobes may be ``hidden`` already."""
    fan = Fan.of(image.azimuth_rad, image.elevation_rad, image.range_m)
    extent = left, right, bottom, top = fan.extent_m()
    step_m = max(right - left, top - bottom) / PIXELS

    def paint(axes: Axes) -> AxesImage:
        range_m, level_db = join_ranges(image.range_m, canvas.level_db(fan.strongest(image.amplitude)))
        range_m, level_db = thickened(range_m, level_db)
        right_m, ahead_m = centres(left, right, step_m), centres(bottom, top, step_m)
        raster = polar_raster(level_db, fan, range_m, right_m=right_m, ahead_m=ahead_m)
        axes.set_axis_off()
        shown = canvas.show(axes, raster, extent=extent, aspect="equal")
        draw_grid(axes, canvas.style, fan, spare_m=step_m / 2)
        axes.plot(0, 0, "^", markersize=0.9 * canvas.style.em_pt, color=canvas.style.ink, clip_on=False)
        return shown

    def finish(axes: Axes) -> None:
        part_names(axes)
        canvas.mark_peaks(axes, place)

    def place(peak: Peak) -> tuple[float, float]:
        x_m, y_m = plan_m(math.radians(peak.azimuth_deg), peak.range_m)
        return float(x_m), float(y_m)

    ratio = float(np.clip((top - bottom) / (right - left), *_SECTOR_RATIOS))
    title = "" if image.is_planar else highest_over("elevation", hidden=hidden)
    return Panel(paint, lambda width_pt: ratio * width_pt, finish, title, title_ems=2.0)


def direction_map(canvas: Canvas, image: Energyscape, *, hidden: bool) -> Panel:
    """Return the maximum over range as a map of azimuth, to the left, and elevation; side lobes may be ``hidden``."""
    level_db = canvas.level_db(image.amplitude.max(axis=1))
    return level_map(
        canvas, level_db, image.azimuth_rad, image.elevation_rad, title=highest_over("range", hidden=hidden)
    )


def level_map(
    canvas: Canvas,
    level_db: NDArray[np.float32],
    azimuth_rad: NDArray[np.float64],
    elevation_rad: NDArray[np.float64],
    *,
    title: str = "",
) -> Panel:
    """Return levels as a map of azimuth, to the left, and elevation."""
    directions = unit_vectors(azimuth_rad, elevation_rad)
    half_deg = math.degrees(spacing_rad(directions)) / 2 if len(directions) > 1 else 1.0
    azimuth_deg = np.degrees(unrolled_rad(azimuth_rad, 3 * math.radians(half_deg)))
    elevation_deg = np.degrees(elevation_rad)
    west, east = float(azimuth_deg.max() + half_deg), float(azimuth_deg.min() - half_deg)
    if west - east > 360.0 - half_deg:  # all around
        west, east = 180.0, -180.0
    low, high = max(-90.0, float(elevation_deg.min() - half_deg)), min(90.0, float(elevation_deg.max() + half_deg))

    def paint(axes: Axes) -> AxesImage:
        step_deg = max(west - east, high - low) / (PIXELS / 2)
        raster = sphere_raster(
            level_db,
            directions,
            azimuth_rad=np.radians(np.arange(west - step_deg / 2, east, -step_deg)),
            elevation_rad=np.radians(np.arange(low + step_deg / 2, high, step_deg)),
        )
        axes.set_xlabel("azimuth (°)")
        axes.set_ylabel("elevation (°)")
        canvas.grid(axes)
        return canvas.show(axes, raster, extent=(west, east, low, high))

    def finish(axes: Axes) -> None:
        width_pt = axes.bbox.width * 72 / axes.figure.dpi
        spacing_deg = 15.0 if max(west - east, high - low) < 100 else 30.0
        while (west - east) / spacing_deg * 3.5 * canvas.style.em_pt > width_pt:
            spacing_deg *= 2
        for axis, span in ((axes.xaxis, west - east), (axes.yaxis, high - low)):
            axis.set_major_locator(MultipleLocator(spacing_deg if span > spacing_deg else max(1.0, round(span / 2))))
        # Ticks have azimuths from -180 to 180, as reflectors have.
        axes.xaxis.set_major_formatter(FuncFormatter(lambda at_deg, _: minus(f"{math.remainder(at_deg, 360.0):g}")))
        canvas.mark_peaks(axes, lambda peak: (east + (peak.azimuth_deg - east) % 360.0, peak.elevation_deg))

    ratio = float(np.clip((high - low) / (west - east), *_MAP_RATIOS))
    return Panel(paint, lambda width_pt: ratio * width_pt, finish, title, box_aspect=ratio)


def curve(canvas: Canvas, image: Energyscape) -> Panel:
    """Return the level over range, of the only direction or of the highest."""

    def paint(axes: Axes) -> None:
        axes.plot(image.range_m, canvas.level_db(image.amplitude.max(axis=0)), color=canvas.style.mark)
        axes.margins(x=0.01)
        axes.set_ylim(-canvas.dynamic_range_db, 3.0)
        axes.set_xlabel("range (m)")
        axes.set_ylabel("dB re strongest")
        canvas.grid(axes)

    def finish(axes: Axes) -> None:
        axes.set_xlim(axes.get_xlim())
        canvas.mark_peaks(axes, lambda peak: (peak.range_m, peak.level_db))

    return Panel(paint, lambda width_pt: _CURVE_RATIO * width_pt, finish)
