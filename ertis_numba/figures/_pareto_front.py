"""Accuracy versus processing time of many plans."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any, Unpack

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._captions import Heading
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures.style import Style, StyleOptions, style_of

__all__ = ["Rated", "front"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rated:
    """A plan of `front`.

    Attributes
    ----------
    series : str
        Name of the measurement; each series has its own line.
    error_db, time_ms : float
    on_front : bool
        True if no other plan is both faster and more accurate.
    label : str
        Text beside the point.
    """

    series: str
    error_db: float
    time_ms: float
    on_front: bool
    label: str = ""


def front(points: Sequence[Rated], *, title: str, note: str = "", **look: Unpack[StyleOptions]) -> Figure:
    """Draw error and time of plans, and the Pareto front as a line.

    Parameters
    ----------
    points : sequence of Rated
    title, note : str
        Heading, and the line below it.
    **look
        Style of the figure, as for `plot`.

    Raises
    ------
    ArgumentError
        The theme is unknown.
    """
    return _draw(style_of(**look), points, title=title, note=note)


def _draw(style: Style, points: Sequence[Rated], *, title: str, note: str) -> Figure:
    """Draw the points of each series in its colour, and a line through its front."""

    def paint(axes: Axes) -> None:
        axes.set_xlabel("error of the image (dB)")
        axes.set_ylabel("time of a measurement (ms)")
        axes.set_yscale("log")
        names = dict.fromkeys(point.series for point in points)
        for look, name in zip(cycle(mpl.rcParams["axes.prop_cycle"]), names, strict=False):
            _draw_series(axes, style, [point for point in points if point.series == name], name, look["color"])
        stroke = [withStroke(linewidth=2.5 * style.line_pt, foreground=style.page)]
        letters: dict[str, Any] = {"color": style.ink, "fontsize": style.label_pt, "path_effects": stroke}
        for point in (each for each in points if each.label):
            place, offset_pt = (point.error_db, point.time_ms), (0, -1.5 * style.em_pt)
            axes.annotate(point.label, place, xytext=offset_pt, textcoords="offset points", ha="center", **letters)
        axes.margins(x=0.08, y=0.1)
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.grid(color=style.faint, alpha=0.3, linewidth=0.6 * style.line_pt)
        axes.legend(fontsize=style.label_pt)

    panel = Panel(paint, lambda width_pt: 0.46 * width_pt)
    return compose(Canvas(style), Heading((title,), (note,) if note else ()), [panel])


def _draw_series(axes: Axes, style: Style, points: Sequence[Rated], name: str, colour: object) -> None:
    front = sorted((point for point in points if point.on_front), key=lambda point: point.error_db)
    others = [point for point in points if not point.on_front]
    width = style.line_pt
    axes.plot(*_places(others), "o", color=colour, markersize=4 * width, alpha=0.5, markeredgewidth=0)
    axes.plot(*_places(front), "o-", color=colour, markersize=6 * width, linewidth=1.4 * width, label=name)


def _places(points: Sequence[Rated]) -> tuple[list[float], list[float]]:
    return [point.error_db for point in points], [point.time_ms for point in points]
