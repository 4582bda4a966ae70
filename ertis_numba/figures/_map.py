"""Occupancy maps seen from above."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._captions import Heading
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures.style import Style
from ertis_numba.frames import OccupancyMap

__all__ = ["draw"]

_MAX_RATIO = 1.5  # Height of a picture relative to its width.


def draw(style: Style, occupancy: OccupancyMap) -> Figure:
    """Draw probabilities in grey, white for free and black for occupied cells."""
    (left_m, right_m), (bottom_m, top_m) = occupancy.limits_m
    ratio = (top_m - bottom_m) / (right_m - left_m)

    def paint(axes: Axes) -> None:
        axes.imshow(
            occupancy.probability,
            extent=(left_m, right_m, bottom_m, top_m),
            origin="lower",
            cmap="gray_r",
            vmin=0.0,
            vmax=1.0,
            interpolation="nearest",
        )
        axes.set_xlabel("x (m)")
        axes.set_ylabel("y (m)")

    size = f"{right_m - left_m:.1f} × {top_m - bottom_m:.1f} m"
    pulses = f"{occupancy.n_groups} pulse" + "s" * (occupancy.n_groups != 1)
    details = (size, f"cells of {100 * occupancy.cell_m:g} cm", pulses, "white is free, grey unknown, black occupied")
    panel = Panel(paint, lambda width_pt: min(ratio, _MAX_RATIO) * width_pt)
    return compose(Canvas(style), Heading(("Occupancy map",), details), [panel])
