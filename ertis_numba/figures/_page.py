"""Page of a figure: heading, pictures, colour bar and list of reflectors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._captions import Heading
from ertis_numba.figures.style import MONOSPACE, Style, parameters, text_width_pt

__all__ = ["Panel", "compose", "save"]

_TITLE_LINE, _LINE, _ROW = 1.35, 1.55, 1.6  # heights of lines, by the size of their letters
_FORMATS = ("pdf", "png", "svg")
_DOT = " · "
_WIDE_EMS = 55.0  # from which on pictures are beside each other
_ACROSS_EMS, _UP_EMS = 6.5, 6.0  # what ticks and names take around a picture
_MAX_ROWS = 24  # of the list below a picture
_MIN_ROWS = 12  # beside one, whatever its height
_LABEL_EMS = 13.0  # length of what is written along the colour bar
_LAYOUT_ROUNDS = 2  # The first measures labels beside axes that do not have their proportions yet.
_SHARE_ALONE = 0.8  # of its box that a colour bar takes which no list is under


@dataclass(frozen=True, slots=True)
class Panel:
    """Picture that is drawn in two steps, because labels find their places only after the axes have theirs."""

    paint: Callable[[Axes], ScalarMappable | None]  # draws, and returns the raster of the colour bar
    height: Callable[[float], float]  # of the axes from their width, in points
    finish: Callable[[Axes], None] = lambda _: None  # draws by the final position
    title: str = ""
    title_ems: float = 0.7
    box_aspect: float | None = None

    def draw_on(self, axes: Axes, style: Style) -> None:
        """Draw into axes of a figure of somebody else."""
        with style.applied():
            self.paint(axes)
            axes.apply_aspect()  # so that names are placed where they are drawn
            self.finish(axes)


def compose(
    canvas: Canvas, heading: Heading, panels: Sequence[Panel], *, width_pt: float = 720.0, stacked: bool = False
) -> Figure:
    """Return a page; Matplotlib's constrained layout places the pictures."""
    style, em_pt, rows = canvas.style, canvas.style.em_pt, canvas.rows()
    width_pt = width_pt if style.width_pt is None else style.width_pt
    wide, margin_pt = width_pt >= _WIDE_EMS * em_pt, min(style.margin_pt, em_pt)
    columns = len(panels) if wide and not stacked else 1
    with style.applied():
        figure = Figure(layout="constrained")
        FigureCanvasAgg(figure)
        pictures: list[Axes] = list(figure.subplots(len(panels) // columns, columns, squeeze=False).flat)
        shown = [panel.paint(axes) for panel, axes in zip(panels, pictures, strict=True)]
        raster = next((each for each in reversed(shown) if each is not None), None)
        list_pt, beside_pt, below_pt = _ROW * style.list_pt, 0.0, 0.0
        if raster is not None and wide:
            widest_pt = max((text_width_pt(row, style.list_pt, MONOSPACE) for row in rows), default=0.0)
            beside_pt = max(widest_pt + 3 * em_pt, 7 * em_pt, style.side_pt)
        elif raster is not None:
            below_pt = 6 * em_pt + list_pt * min(len(rows), _MAX_ROWS)
        each_pt = (width_pt - beside_pt - 2 * margin_pt) / columns - _ACROSS_EMS * em_pt
        heights_pt = [panel.height(each_pt) + _UP_EMS * em_pt for panel in panels]
        body_pt = max(heights_pt) if columns > 1 else sum(heights_pt)
        if beside_pt:  # There is room for the colour bar and some reflectors beside pictures of any height.
            lying_pt = 6.3 * em_pt + list_pt * min(len(rows), _MIN_ROWS)
            body_pt = max(body_pt, lying_pt if rows else _LABEL_EMS / _SHARE_ALONE * em_pt + 1.0)
        lines, head_pt = _lines(style, heading, width_pt - beside_pt - style.margin_pt - margin_pt)
        size_pt = width_pt, head_pt + body_pt + below_pt + margin_pt
        figure.set_size_inches(size_pt[0] / 72, size_pt[1] / 72)
        for top_pt, options in lines:
            _write(figure, style.margin_pt, size_pt[1] - top_pt, **options)
        _place(figure, pictures, panels, heights_pt, (margin_pt, margin_pt + below_pt, width_pt - beside_pt, body_pt))
        if raster is not None:
            left_pt, tall_pt = (width_pt - beside_pt, body_pt) if wide else (margin_pt, below_pt)
            _explain(figure, canvas, raster, rows, (left_pt, margin_pt, width_pt - left_pt - margin_pt, tall_pt))
        for panel, axes in zip(panels, pictures, strict=True):
            panel.finish(axes)
    return figure


def _place(
    figure: Figure,
    pictures: Sequence[Axes],
    panels: Sequence[Panel],
    heights_pt: Sequence[float],
    box_pt: tuple[float, float, float, float],
) -> None:
    """Place the pictures in a box, which is left, bottom, right and height, once and for all."""
    width_pt, height_pt = 72 * figure.get_size_inches()
    grid: Any = pictures[0].get_gridspec()
    if grid.ncols == 1:
        grid.set_height_ratios(heights_pt)
    pad_pt = max(panel.title_ems for panel in panels) * mpl.rcParams["axes.labelsize"]
    for panel, axes in zip(panels, pictures, strict=True):
        axes.set_title(panel.title, pad=pad_pt)
        axes.set_box_aspect(panel.box_aspect)
        axes.set_anchor("N")
    left_pt, bottom_pt, right_pt, tall_pt = box_pt
    engine: Any = figure.get_layout_engine()
    rect = (left_pt / width_pt, bottom_pt / height_pt, (right_pt - 2 * left_pt) / width_pt, tall_pt / height_pt)
    engine.set(rect=rect, w_pad=0.02, h_pad=0.02, wspace=0.03, hspace=0.03)
    for _ in range(_LAYOUT_ROUNDS):
        engine.execute(figure)
    figure.set_layout_engine("none")


def _explain(
    figure: Figure,
    canvas: Canvas,
    raster: ScalarMappable,
    rows: list[str],
    box_pt: tuple[float, float, float, float],
) -> None:
    """Draw the colour bar into a box, which is left, bottom, width and height, and the list of reflectors below it."""
    style = canvas.style
    (left_pt, bottom_pt, width_pt, tall_pt), em_pt = box_pt, style.em_pt
    bar_pt, top_pt = min(16 * em_pt, (0.45 if rows else _SHARE_ALONE) * tall_pt), bottom_pt + tall_pt
    upright = bar_pt >= _LABEL_EMS * em_pt and width_pt < 30 * em_pt
    if upright:
        bar = (left_pt + em_pt, top_pt - bar_pt - 2 * em_pt, 1.3 * em_pt, bar_pt)
    else:
        bar = (left_pt + 0.1 * width_pt, top_pt - 2.2 * em_pt, 0.8 * width_pt, em_pt)
    across_pt, up_pt = 72 * figure.get_size_inches()
    axes = figure.add_axes((bar[0] / across_pt, bar[1] / up_pt, bar[2] / across_pt, bar[3] / up_pt))
    orientation = "vertical" if upright else "horizontal"
    figure.colorbar(raster, cax=axes, orientation=orientation, label=canvas.unit)
    for solid in axes.collections:
        solid.set_rasterized(True)  # hundreds of colours are one picture in a file of vectors
    top_pt = bar[1] - (2.0 if upright else 3.6) * em_pt
    fitting = int((top_pt - bottom_pt) / (_ROW * style.list_pt))
    if len(rows) > fitting:
        rows = [*rows[: max(fitting - 1, 0)], f"and {len(rows) - max(fitting - 1, 1)} more"]
    if rows and fitting >= min(2, len(rows)):
        left_pt += em_pt if upright else 0
        _write(figure, left_pt, top_pt, "\n".join(rows), size=style.list_pt, family=MONOSPACE, color=style.ink)


def _lines(style: Style, heading: Heading, width_pt: float) -> tuple[list[tuple[float, dict[str, Any]]], float]:
    """Return the texts of the heading with their distances from the top, and the height of all."""
    title = _wrapped(heading.title, style.title_pt, style.font, width_pt, bold=True)
    settings = _wrapped(heading.settings, style.label_pt, style.font, width_pt)
    top_pt = 0.6 * style.margin_pt
    below_pt = top_pt + _TITLE_LINE * style.title_pt * len(title)
    bold = {"text": "\n".join(title), "size": style.title_pt, "weight": "bold", "color": style.ink}
    plain = {"text": "\n".join(settings), "size": style.label_pt}
    texts = [(top_pt, {**bold, "line": _TITLE_LINE}), (below_pt, plain)]
    return texts, below_pt + _LINE * style.label_pt * len(settings) + 0.4 * style.em_pt


def _write(figure: Figure, left_pt: float, top_pt: float, text: str, *, line: float = _LINE, **look: Any) -> None:
    """Write lines whose upper left corner is given; Matplotlib's lines are a fifth higher than their letters."""
    width_pt, height_pt = 72 * figure.get_size_inches()
    figure.text(left_pt / width_pt, top_pt / height_pt, text, va="top", linespacing=line / 1.2, **look)


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


def save(figure: Figure, target: str | Path | IO[bytes], *, format: str | None = None) -> None:  # noqa: A002 - as savefig
    """Write a figure as .png, .svg or .pdf, the same bytes each time; letters of a .pdf can be searched and edited.

    Parameters
    ----------
    figure : Figure
    target : str, Path or binary file
    format : {"png", "svg", "pdf"}, optional
        By default the suffix of the name.

    Raises
    ------
    ArgumentError
        The format is unknown, or the name has none.
    """
    kind = format or Path(str(target)).suffix.lower().lstrip(".")
    if format:
        checks.choice("format", format, _FORMATS)
    elif kind not in _FORMATS:
        raise ArgumentError(
            "an open file has no name that states a format; set format"
            if hasattr(target, "write")
            else f"{target} ends in none of .pdf, .png and .svg; use such a name, or set format"
        )
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    with parameters({"pdf.fonttype": 42, "svg.hashsalt": "ertis"}):
        figure.savefig(target, format=kind, metadata=undated)
