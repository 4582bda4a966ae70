"""Points from above, in metres."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from ertis_numba.base.units import counted
from ertis_numba.figures import _captions
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._page import Panel, compose
from ertis_numba.frames import PointCloud

__all__ = ["draw"]

_RATIO = 0.6
_SPARE = 1.1  # reach of the axes, relative to that of the points


def draw(canvas: Canvas, cloud: PointCloud) -> Figure:
    """Draw points in colours of their levels, the strongest on top; unconfirmed points of a fusion are rings."""
    style, certain = canvas.style, cloud.is_certain
    left_m, ahead_m = cloud.position_m[:, 1].astype(np.float64), cloud.position_m[:, 0].astype(np.float64)
    level_db = canvas.level_db(cloud.amplitude)

    def paint(axes: Axes) -> ScalarMappable:
        look: dict[str, Any] = {"s": 4 * style.em_pt, "vmin": -canvas.dynamic_range_db, "vmax": 0.0}
        order = np.flatnonzero(certain)[::-1]
        shown = axes.scatter(left_m[order], ahead_m[order], c=level_db[order], **look)
        axes.plot(left_m[~certain], ahead_m[~certain], "o", fillstyle="none", color=style.faint, zorder=0)
        axes.plot(0, 0, "^", markersize=0.9 * style.em_pt, color=style.ink)
        axes.set_xlabel("y, left (m)")
        axes.set_ylabel("x, forward (m)")
        canvas.grid(axes)
        return shown

    def finish(axes: Axes) -> None:
        """Set limits with one scale for both axes, around the points and the sensor."""
        (right, left), (back, front) = ((min(*each, 0.0), max(*each, 0.0)) for each in (left_m, ahead_m))
        scale = _SPARE * max((left - right) / axes.bbox.width, (front - back) / axes.bbox.height) or 1e-3
        across, ahead = (left + right) / 2, (front + back) / 2
        axes.set_xlim(across + scale * axes.bbox.width / 2, across - scale * axes.bbox.width / 2)
        axes.set_ylim(ahead - scale * axes.bbox.height / 2, ahead + scale * axes.bbox.height / 2)

    n_doubtful = int(np.count_nonzero(~certain))
    parts = (counted(len(cloud), "point"), *((f"{n_doubtful} unconfirmed, as rings",) if n_doubtful else ()))
    heading = _captions.of_measurement("Points from above", cloud.settings, cloud.stamp, *parts, values=cloud.amplitude)
    return compose(canvas, heading, [Panel(paint, lambda width_pt: _RATIO * width_pt, finish)])
