"""Styles of figures: colours, letters and sizes, on a screen and in print."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal, TypedDict

import matplotlib as mpl
from cycler import cycler
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.base.forks import ForkSafeLock

__all__ = [
    "COLUMNS_MM",
    "FONTS",
    "LINES",
    "MONOSPACE",
    "THEMES",
    "Style",
    "StyleOptions",
    "angle",
    "minus",
    "parameters",
    "style_of",
    "text_width_pt",
]

COLUMNS_MM = {1: 85.0, 2: 170.0}
"""Width of a picture for print over so many columns of a page."""
FONTS = {"sans": "DejaVu Sans", "serif": "STIXGeneral"}  # both come with Matplotlib; the second is like Times
MONOSPACE = "DejaVu Sans Mono"
LINES: tuple[str, ...] = ("-", "--", "-.", ":")  # which tell curves apart where colours are not printed

_PT_PER_MM = 72 / 25.4
_SLACK = 1.03  # letters are set to whole pixels on a screen
_LOCK = ForkSafeLock(threading.RLock)
_SHADES = (0.6, 0.8, 0.45, 0.95)  # of the map of colours, for the second line on


class StyleOptions(TypedDict, total=False):
    """Style options of all functions of this package.

    Attributes
    ----------
    theme : {"dark", "light", "paper"}
        Theme for a screen, or for print: white, with letters and lines in printed size.
    columns : {1, 2}
        Width of ``paper``: 85 mm for one column or 170 mm for two, the default.
    font : {"sans", "serif"}
    """

    theme: Literal["dark", "light", "paper"]
    columns: Literal[1, 2] | None
    font: Literal["sans", "serif"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Style:
    """Colours, letters and sizes; ``colours`` is a perceptually uniform map of Matplotlib."""

    page: str
    ink: str
    faint: str
    mark: str
    colours: str
    font: str = FONTS["sans"]
    title_pt: float = 14.0
    label_pt: float = 9.0
    tick_pt: float = 8.5
    list_pt: float = 7.5
    line_pt: float = 1.0
    margin_pt: float = 30.0
    side_pt: float = 166.0  # minimum width for scale and list
    dpi: int = 160
    width_pt: float | None = None  # of the page; None: by the kind of picture

    @property
    def rc(self) -> Any:
        """Parameters of Matplotlib in which figures of this style are drawn."""
        faint, line_pt = self.faint, self.line_pt
        ticks = {"color": faint, "labelsize": self.tick_pt, "major.width": 0.8 * line_pt, "major.size": 3.5 * line_pt}
        return {
            **{f"{axis}tick.{name}": value for axis in "xy" for name, value in ticks.items()},
            "figure.dpi": self.dpi,
            "figure.facecolor": self.page,
            "axes.facecolor": self.page,
            "axes.edgecolor": faint,
            "axes.linewidth": 0.8 * line_pt,
            "axes.labelcolor": faint,
            "axes.labelsize": self.label_pt,
            "axes.titlecolor": faint,
            "axes.titlesize": self.label_pt,
            "axes.prop_cycle": cycler(color=[self.mark, *(mpl.colormaps[self.colours](at) for at in _SHADES)]),
            "font.family": self.font,
            "font.size": self.tick_pt,
            "image.cmap": self.colours,
            "legend.facecolor": self.page,
            "legend.edgecolor": faint,
            "legend.labelcolor": self.ink,
            "legend.fontsize": self.tick_pt,
            "legend.title_fontsize": self.tick_pt,
            "lines.linewidth": line_pt,
            "text.color": faint,
            "text.parse_math": False,  # A file's name may hold a dollar sign.
        }

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Draw in this style."""
        with parameters(self.rc):
            yield

    @property
    def em_pt(self) -> float:
        """Font size of labels, the unit of distances."""
        return self.label_pt


THEMES = {
    "dark": Style(page="#0b0d12", ink="#e8eaf0", faint="#9aa0b0", mark="#7fe7ff", colours="inferno"),
    "light": Style(page="#ffffff", ink="#1b1e26", faint="#5f6573", mark="#00617d", colours="magma_r"),
    "paper": Style(
        page="#ffffff",
        ink="#000000",
        faint="#404040",
        mark="#00617d",
        colours="magma_r",
        title_pt=8.0,
        label_pt=7.0,
        tick_pt=6.5,
        list_pt=6.0,
        line_pt=0.6,
        margin_pt=3.0,
        side_pt=50.0,
        dpi=300,
        width_pt=COLUMNS_MM[2] * _PT_PER_MM,
    ),
}


@contextmanager
def parameters(rc: Any) -> Iterator[None]:
    """Set parameters of Matplotlib for a while; one thread at a time, because they are global."""
    with _LOCK, mpl.rc_context(rc):
        yield


def style_of(
    theme: Literal["dark", "light", "paper"] = "dark",
    columns: Literal[1, 2] | None = None,
    font: Literal["sans", "serif"] = "sans",
) -> Style:
    """Return a style by its name; only the theme "paper" has columns."""
    checks.choice("theme", theme, THEMES)
    checks.choice("font", font, FONTS)
    style = replace(THEMES[theme], font=FONTS[font])
    if columns is None:
        return style
    checks.choice("columns", columns, COLUMNS_MM)
    if style.width_pt is None:
        raise ArgumentError(f"columns is {columns}, which theme {theme!r} does not have; use theme 'paper'")
    return replace(style, width_pt=COLUMNS_MM[columns] * _PT_PER_MM)


def text_width_pt(text: str, size_pt: float, font: str, *, bold: bool = False) -> float:
    """Return an upper estimate of the width of a line of text."""
    properties = FontProperties(family=font, size=size_pt, weight="bold" if bold else "normal")
    return _SLACK * text_to_path.get_text_width_height_descent(text, properties, ismath=False)[0]


def angle(degrees: float) -> str:
    """Return an angle with its sign, as the axes write it."""
    text = minus(f"{degrees:+.1f}".removesuffix(".0"))
    return "0°" if text in {"+0", "−0"} else f"{text}°"


def minus(text: str) -> str:
    """Return a number with the sign that printers use."""
    return text.replace("-", "−")
