"""Layout of a page, in points from its lower left corner: heading, pictures, colour bar."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ertis_numba.figures._words import Heading
from ertis_numba.figures.style import Style, text_width_pt

__all__ = ["FigurePage", "PageBox", "lay_out"]

_TITLE_LINE, _LINE = 1.35, 1.55  # heights of lines, by the size of their letters
_DOT = " · "
_GAP_EMS = 2.0  # between pictures


@dataclass(frozen=True, slots=True)
class PageBox:
    """A rectangle on a page, in points."""

    left: float
    bottom: float
    width: float
    height: float

    def inset(self, *, left: float = 0.0, right: float = 0.0, bottom: float = 0.0, top: float = 0.0) -> "PageBox":
        """Return the box within margins."""
        return PageBox(self.left + left, self.bottom + bottom, self.width - left - right, self.height - bottom - top)

    def fitted(self, ratio: float) -> "PageBox":
        """Return the largest inner box with a given ratio of height to width, centred at the top."""
        width = min(self.width, self.height / ratio)
        height = width * ratio
        return PageBox(self.left + (self.width - width) / 2, self.bottom + self.height - height, width, height)


class FigurePage:
    """Figure with its heading.

    Parameters
    ----------
    style : Style
    heading : Heading
    width_pt : float
    body_pt : float
        Height of the part below the heading.
    heading_pt : float
        Width that the heading may take.

    Attributes
    ----------
    figure : Figure
    style : Style
    """

    def __init__(self, style: Style, heading: Heading, *, width_pt: float, body_pt: float, heading_pt: float) -> None:
        title = _wrapped(heading.title, style.title_pt, style.font, heading_pt, bold=True)
        lines = _wrapped(heading.settings, style.label_pt, style.font, heading_pt)
        title_pt = _TITLE_LINE * style.title_pt * len(title)
        head_pt = style.margin_pt * 0.6 + title_pt + _LINE * style.label_pt * len(lines) + 0.4 * style.em_pt
        self.style = style
        self._size_pt = width_pt, body_pt + head_pt
        size_in = (width_pt / 72, (body_pt + head_pt) / 72)
        self.figure = Figure(figsize=size_in, dpi=style.dpi, facecolor=style.page)
        FigureCanvasAgg(self.figure)
        top_pt = body_pt + head_pt - style.margin_pt * 0.6
        self.text("\n".join(title), style.margin_pt, top_pt, style.title_pt, bold=True, spacing=_TITLE_LINE)
        self.text(
            "\n".join(lines), style.margin_pt, top_pt - title_pt, style.label_pt, colour=style.faint, spacing=_LINE
        )

    def text(
        self,
        text: str,
        left_pt: float,
        top_pt: float,
        size_pt: float,
        *,
        bold: bool = False,
        colour: str | None = None,
        font: str | None = None,
        align: str = "left",
        spacing: float = _LINE,
    ) -> None:
        """Write lines whose upper left corner is given."""
        width_pt, height_pt = self._size_pt
        self.figure.text(
            left_pt / width_pt,
            top_pt / height_pt,
            text,
            color=colour or self.style.ink,
            fontsize=size_pt,
            fontweight="bold" if bold else "normal",
            family=font or self.style.font,
            linespacing=spacing / 1.2,  # Matplotlib's lines are a fifth higher than their letters
            ha=align,
            va="top",
            parse_math=False,  # a file's name may hold a dollar sign
        )

    def caption(self, box: PageBox, text: str, *, above_pt: float = 0.0) -> None:
        """Write a line at the top of a box, or so far above it, in its middle."""
        if text:
            left_pt, top_pt = box.left + box.width / 2, box.bottom + (box.height + above_pt)
            self.text(text, left_pt, top_pt, self.style.label_pt, colour=self.style.faint, align="center")

    def axes(self, box: PageBox, *, title: str = "", x: str = "", y: str = "") -> Axes:
        """Return new axes in the colours and letters of the style."""
        width_pt, height_pt = self._size_pt
        style = self.style
        axes = self.figure.add_axes(
            (box.left / width_pt, box.bottom / height_pt, box.width / width_pt, box.height / height_pt)
        )
        axes.set_facecolor(style.page)
        axes.tick_params(
            colors=style.faint,
            labelsize=style.tick_pt,
            labelfontfamily=style.font,
            width=0.8 * style.line_pt,
            length=3.5 * style.line_pt,
        )
        for spine in axes.spines.values():
            spine.set_color(style.faint)
            spine.set_linewidth(0.8 * style.line_pt)
        label: dict[str, Any] = {
            "color": style.faint,
            "fontsize": style.label_pt,
            "family": style.font,
            "parse_math": False,
        }
        axes.set_xlabel(x, **label)
        axes.set_ylabel(y, **label)
        if title:
            axes.set_title(title, pad=0.6 * style.em_pt, **label)
        return axes


def lay_out(
    style: Style,
    heading: Heading,
    panels: Sequence[Callable[[float], float]],
    *,
    width_pt: float,
    side_pt: float,
    below_pt: float,
    side_tall_pt: float = 0.0,
) -> tuple[FigurePage, list[PageBox], PageBox]:
    """Return a page, the boxes of its pictures and that of their colour bar and list.

    On a wide page, the pictures are beside each other, with the rest on their right. On a narrow one, all parts are
    below each other.

    Parameters
    ----------
    style : Style
    heading : Heading
    panels : sequence of callable
        Functions that return the height of a picture from its width, both in points.
    width_pt : float
        Width of the page if the style has none.
    side_pt : float
        Width of the rest if it is beside the pictures.
    below_pt : float
        Height of the rest if it is below the pictures.
    side_tall_pt : float
        Minimum height of the rest if it is beside the pictures.
    """
    width_pt = width_pt if style.width_pt is None else style.width_pt
    gap_pt, margin_pt = _GAP_EMS * style.em_pt, min(style.margin_pt, style.em_pt)
    if style.is_wide(width_pt):
        side_pt = max(side_pt, style.side_pt) if side_pt else 0.0
        each_pt = (width_pt - side_pt - 2 * margin_pt - gap_pt * (len(panels) - 1)) / len(panels)
        tall_pt = max(side_tall_pt, *(panel(each_pt) for panel in panels))
        page = FigurePage(
            style,
            heading,
            width_pt=width_pt,
            body_pt=tall_pt + margin_pt,
            heading_pt=width_pt - side_pt - style.margin_pt - margin_pt,
        )
        boxes = [
            PageBox(margin_pt + number * (each_pt + gap_pt), margin_pt, each_pt, tall_pt)
            for number in range(len(panels))
        ]
        return page, boxes, PageBox(width_pt - side_pt, margin_pt, side_pt - margin_pt, tall_pt)
    each_pt = width_pt - 2 * margin_pt
    heights = [panel(each_pt) for panel in panels]
    body_pt = sum(heights) + gap_pt * (len(panels) - 1) + below_pt + margin_pt
    page = FigurePage(style, heading, width_pt=width_pt, body_pt=body_pt, heading_pt=width_pt - 2 * style.margin_pt)
    boxes, top_pt = [], body_pt
    for height_pt in heights:
        boxes.append(PageBox(margin_pt, top_pt - height_pt, each_pt, height_pt))
        top_pt -= height_pt + gap_pt
    return page, boxes, PageBox(margin_pt, margin_pt, each_pt, below_pt)


def _wrapped(parts: Sequence[str], size_pt: float, font: str, width_pt: float, *, bold: bool = False) -> list[str]:
    """Return lines that fit into a width, of parts that stay whole unless one alone is too long."""

    def fits(text: str) -> bool:
        return text_width_pt(text, size_pt, font, bold=bold) <= width_pt

    lines: list[str] = []
    for part in parts:
        cut = part
        while not fits(cut) and len(cut) > 2:
            cut = f"{cut[:-2]}…"
        if lines and fits(f"{lines[-1]}{_DOT}{cut}"):
            lines[-1] += f"{_DOT}{cut}"
        else:
            lines.append(cut)
    return lines
