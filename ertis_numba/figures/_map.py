"""Occupancy maps seen from above, and from the side."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._captions import Heading
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures.style import Style
from ertis_numba.frames import OCCUPIED_ABOVE, OccupancyMap

__all__ = ["draw"]

_MAX_RATIO = 1.5  # Height of a picture relative to its width.


def draw(style: Style, occupancy: OccupancyMap) -> Figure:
    """Draw probabilities in grey, white for free and black for occupied cells; also from the side in 3D."""
    limits_m = occupancy.limits_m
    if occupancy.n_dimensions == 2:
        panels = [_panel(occupancy.probability, limits_m[0], limits_m[1], "y")]
    else:
        above, beside = (_seen(occupancy.probability, axis) for axis in (0, 1))
        panels = [
            _panel(above, limits_m[0], limits_m[1], "y", "from above"),
            _panel(beside, limits_m[0], limits_m[2], "z", "from the side"),
        ]
    size = " × ".join(f"{high_m - low_m:.1f}" for low_m, high_m in limits_m) + " m"
    pulses = f"{occupancy.n_groups} pulse" + "s" * (occupancy.n_groups != 1)
    details = (size, f"cells of {100 * occupancy.cell_m:g} cm", pulses, "white is free, grey unknown, black occupied")
    return compose(Canvas(style), Heading(("Occupancy map",), details), panels)


def _panel(
    probability: NDArray[np.float32],
    across_m: tuple[float, float],
    up_m: tuple[float, float],
    name: str,
    title: str = "",
) -> Panel:
    ratio = (up_m[1] - up_m[0]) / (across_m[1] - across_m[0])

    def paint(axes: Axes) -> None:
        axes.imshow(
            probability,
            extent=(*across_m, *up_m),
            origin="lower",
            cmap="gray_r",
            vmin=0.0,
            vmax=1.0,
            interpolation="nearest",
        )
        axes.set_xlabel("x (m)")
        axes.set_ylabel(f"{name} (m)")

    return Panel(paint, lambda width_pt: min(ratio, _MAX_RATIO) * width_pt, title=title)


def _seen(probability: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Return the highest probability along an axis, or the lowest one where no cell is occupied."""
    highest = probability.max(axis=axis)
    return np.asarray(np.where(highest > OCCUPIED_ABOVE, highest, probability.min(axis=axis)))
