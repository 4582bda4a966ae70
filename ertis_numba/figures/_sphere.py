"""An image with elevations: a map of the directions, and a plan."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from ertis_numba.figures import _sector
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._sampling import PIXELS, maximum_over_elevation, spacing_rad, sphere_raster
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import unit_vectors

__all__ = ["draw"]


def draw(canvas: Canvas, image: Energyscape) -> Figure:
    """Draw the maximum over range as a map, and the maximum over elevation as a sector."""
    figure = canvas.figure(image, width_in=14.0, height_in=6.0)
    level_db = canvas.level_db(image.energy)
    axes = figure.add_axes((0.055, 0.10, 0.34, 0.72))
    _map(canvas, axes, image, level_db.max(axis=1))
    axes.set_title("strongest over range", color=canvas.theme.faint, fontsize=9)
    spacing = spacing_rad(unit_vectors(image.azimuth_rad, image.elevation_rad))
    azimuth_rad, highest_db = maximum_over_elevation(level_db, image.azimuth_rad, spacing_rad=spacing)
    axes = figure.add_axes((0.405, 0.02, 0.42, 0.80))
    shown = _sector.draw_into(canvas, axes, azimuth_rad, image.range_m, highest_db)
    axes.set_title("strongest over elevation", color=canvas.theme.faint, fontsize=9)
    canvas.side(figure, shown, left=0.835)
    return figure


def _map(canvas: Canvas, axes: Axes, image: Energyscape, level_db: NDArray[np.float32]) -> None:
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    half_deg = math.degrees(spacing_rad(directions)) / 2
    azimuth_deg, elevation_deg = np.degrees(image.azimuth_rad), np.degrees(image.elevation_rad)
    west, east = azimuth_deg.max() + half_deg, azimuth_deg.min() - half_deg
    low, high = max(-90.0, elevation_deg.min() - half_deg), min(90.0, elevation_deg.max() + half_deg)
    step_deg = max(west - east, high - low) / (PIXELS / 2)
    raster = sphere_raster(
        level_db,
        directions,
        azimuth_rad=np.radians(np.arange(west - step_deg / 2, east, -step_deg)),
        elevation_rad=np.radians(np.arange(low + step_deg / 2, high, step_deg)),
    )
    canvas.style(axes)
    canvas.show(axes, raster, extent=(west, east, low, high))
    axes.set_xlabel("azimuth (°)")
    axes.set_ylabel("elevation (°)")
    spacing_deg = 15 if max(west - east, high - low) < 100 else 30
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(spacing_deg))
    axes.grid(color=canvas.theme.faint, alpha=0.3, linewidth=0.6)
    canvas.mark_peaks(axes, lambda peak: (peak.azimuth_deg, peak.elevation_deg))
    axes.set_xlim(west, east)
    axes.set_ylim(low, high)
