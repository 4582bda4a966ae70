"""Accuracy versus processing time of many plans."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ertis_numba.figures._page import lay_out
from ertis_numba.figures._words import Heading
from ertis_numba.figures.style import Style

__all__ = ["Rated", "draw"]

_COLOURS = (0.75, 0.45, 0.6, 0.9)  # places in the theme's map, of the second series on


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


def draw(style: Style, points: Sequence[Rated], *, title: str, note: str) -> Figure:
    """Draw the points of each series in its colour, and a line through its front."""
    em_pt = style.em_pt
    page, (box,), _ = lay_out(
        style,
        Heading((title,), (note,) if note else ()),
        [lambda width_pt: 0.48 * width_pt],
        width_pt=720.0,
        side_pt=0.0,
        below_pt=0.0,
    )
    axes = page.axes(
        box.inset(left=5.0 * em_pt, right=1.5 * em_pt, bottom=4.0 * em_pt, top=em_pt),
        x="error of the image (dB)",
        y="time of a measurement (ms)",
    )
    axes.set_yscale("log")
    shades = mpl.colormaps[style.colours]
    for number, series in enumerate(dict.fromkeys(point.series for point in points)):
        colour = shades(_COLOURS[(number - 1) % len(_COLOURS)]) if number else style.mark
        _draw_series(axes, style, [point for point in points if point.series == series], series, colour)
    for point in points:
        if point.label:
            axes.annotate(
                point.label,
                (point.error_db, point.time_ms),
                xytext=(0, -1.5 * em_pt),
                textcoords="offset points",
                ha="center",
                color=style.ink,
                fontsize=style.label_pt,
                family=style.font,
                path_effects=[withStroke(linewidth=2.5 * style.line_pt, foreground=style.page)],
            )
    axes.margins(x=0.05, y=0.1)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color=style.faint, alpha=0.3, linewidth=0.6 * style.line_pt)
    axes.legend(
        facecolor=style.page,
        edgecolor=style.faint,
        labelcolor=style.ink,
        prop={"family": style.font, "size": style.label_pt},
    )
    return page.figure


def _draw_series(axes: Axes, style: Style, points: Sequence[Rated], name: str, colour: object) -> None:
    front = sorted((point for point in points if point.on_front), key=lambda point: point.error_db)
    others = [point for point in points if not point.on_front]
    width = style.line_pt
    axes.plot(*_places(others), "o", color=colour, markersize=4 * width, alpha=0.5, markeredgewidth=0)
    axes.plot(*_places(front), "o-", color=colour, markersize=6 * width, linewidth=1.4 * width, label=name)


def _places(points: Sequence[Rated]) -> tuple[list[float], list[float]]:
    return [point.error_db for point in points], [point.time_ms for point in points]
