"""What exactness costs: error against time of many plans."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ertis_numba.figures._canvas import Canvas

__all__ = ["Rated", "draw"]

_COLOURS = (0.75, 0.45, 0.6, 0.9)  # places in the theme's map, of the second series on


@dataclass(frozen=True, slots=True, kw_only=True)
class Rated:
    """A plan of `front`.

    Attributes
    ----------
    series : str
        What it was measured on; each has a line of its own.
    error_db, time_ms : float
    on_front : bool
        No other plan is both faster and more exact.
    label : str
        Written beside it.
    """

    series: str
    error_db: float
    time_ms: float
    on_front: bool
    label: str = ""


def draw(canvas: Canvas, points: Sequence[Rated], *, title: str, note: str) -> Figure:
    """Draw the points of each series in its colour, and a line through its front."""
    figure = canvas.page(title, note, width_in=10.0, height_in=5.6)
    axes = figure.add_axes((0.08, 0.12, 0.88, 0.72))
    canvas.style(axes)
    axes.set_yscale("log")
    shades = mpl.colormaps[canvas.theme.colours]
    for number, series in enumerate(dict.fromkeys(point.series for point in points)):
        colour = shades(_COLOURS[(number - 1) % len(_COLOURS)]) if number else canvas.theme.mark
        _draw_series(axes, [point for point in points if point.series == series], series, colour)
    for point in points:
        if point.label:
            axes.annotate(
                point.label,
                (point.error_db, point.time_ms),
                xytext=(0, -14),
                textcoords="offset points",
                ha="center",
                color=canvas.theme.ink,
                fontsize=9,
                path_effects=[withStroke(linewidth=2.5, foreground=canvas.theme.page)],
            )
    axes.margins(x=0.05, y=0.1)
    axes.set_xlabel("error of the image (dB)")
    axes.set_ylabel("time of a measurement (ms)")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color=canvas.theme.faint, alpha=0.3, linewidth=0.6)
    axes.legend(facecolor=canvas.theme.page, edgecolor=canvas.theme.faint, labelcolor=canvas.theme.ink, fontsize=9)
    return figure


def _draw_series(axes: Axes, points: Sequence[Rated], name: str, colour: object) -> None:
    front = sorted((point for point in points if point.on_front), key=lambda point: point.error_db)
    others = [point for point in points if not point.on_front]
    axes.plot(*_places(others), "o", color=colour, markersize=4, alpha=0.5, markeredgewidth=0)
    axes.plot(*_places(front), "o-", color=colour, markersize=6, linewidth=1.4, label=name)


def _places(points: Sequence[Rated]) -> tuple[list[float], list[float]]:
    return [point.error_db for point in points], [point.time_ms for point in points]
