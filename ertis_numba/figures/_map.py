"""Occupancy maps seen from above, and from the side."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._captions import Heading
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures.style import Style
from ertis_numba.frames import OCCUPIED_ABOVE, OccupancyMap, Trajectory

__all__ = ["draw"]

_MAX_RATIO = 1.5  # Height of a picture relative to its width.
_POSE = "#c8452d"  # Visible on white, grey and black.
Mounting = tuple[Sequence[float], Sequence[float]]


def draw(
    style: Style, occupancy: OccupancyMap, trajectory: Trajectory | None, mountings: Mapping[str, Mounting]
) -> Figure:
    """Draw probabilities in grey, white for free and black for occupied cells; also from the side in 3D."""
    poses = _PathMarks(style, trajectory, mountings)
    limits_m = occupancy.limits_m
    if occupancy.n_dimensions == 2:
        panels = [_panel(poses, occupancy.probability, limits_m[0], limits_m[1], "y")]
    else:
        above, beside = (_seen(occupancy.probability, axis) for axis in (0, 1))
        panels = [
            _panel(poses, above, limits_m[0], limits_m[1], "y", "from above"),
            _panel(poses, beside, limits_m[0], limits_m[2], "z", "from the side"),
        ]
    size = " × ".join(f"{high_m - low_m:.1f}" for low_m, high_m in limits_m) + " m"
    pulses = f"{occupancy.n_groups} pulse" + "s" * (occupancy.n_groups != 1)
    colours = "white is free, grey unknown, black occupied"
    details = (size, f"cells of {100 * occupancy.cell_m:g} cm", pulses, colours, *poses.legend)
    return compose(Canvas(style), Heading(("Occupancy map",), details), panels)


class _PathMarks:
    """Path of the platform, its last pose and the sensors there, as marks over a map."""

    def __init__(self, style: Style, trajectory: Trajectory | None, mountings: Mapping[str, Mounting]) -> None:
        from scipy.spatial.transform import Rotation  # noqa: PLC0415  few want it

        self._style = style
        self._path_m = np.empty((0, 3)) if trajectory is None else trajectory.position_m
        self._ahead, self._sensors_m = np.zeros(3), np.empty((0, 3))
        self.legend: tuple[str, ...] = ()
        if trajectory is None:
            return
        last = Rotation.from_quat(trajectory.rotation_xyzw[-1])
        self._ahead = last.apply([1.0, 0.0, 0.0])
        places_m = np.array([place for place, _ in mountings.values()], np.float64).reshape(-1, 3)
        self._sensors_m = self._path_m[-1] + last.apply(places_m) if len(places_m) else places_m
        self.legend = ("line and arrow: path and last heading", *(("dots: sensors",) if mountings else ()))

    def draw(self, axes: Axes, up: int) -> None:
        """Draw them in the plane of x and of the axis ``up``, without changing the limits."""
        if not len(self._path_m):
            return
        limits = axes.get_xlim(), axes.get_ylim()
        line_pt, em_pt = self._style.line_pt, self._style.em_pt
        axes.plot(self._path_m[:, 0], self._path_m[:, up], color=_POSE, linewidth=1.2 * line_pt)
        length_m = 0.06 * (limits[0][1] - limits[0][0])
        tip_m = self._path_m[-1] + length_m * self._ahead
        arrow = {"arrowstyle": "-|>", "color": _POSE, "linewidth": 1.2 * line_pt, "mutation_scale": em_pt}
        tip, end = ((float(each[0]), float(each[up])) for each in (tip_m, self._path_m[-1]))
        axes.annotate("", tip, end, arrowprops=arrow)
        axes.plot(self._sensors_m[:, 0], self._sensors_m[:, up], "o", markersize=0.3 * em_pt, color=_POSE)
        axes.set_xlim(limits[0])
        axes.set_ylim(limits[1])


def _panel(
    poses: _PathMarks,
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
        poses.draw(axes, "xyz".index(name))

    return Panel(paint, lambda width_pt: min(ratio, _MAX_RATIO) * width_pt, title=title)


def _seen(probability: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Return the highest probability along an axis, or the lowest one where no cell is occupied."""
    highest = probability.max(axis=axis)
    return np.asarray(np.where(highest > OCCUPIED_ABOVE, highest, probability.min(axis=axis)))
