"""Image of one direction: level over range."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ertis_numba.figures import _words
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._page import lay_out
from ertis_numba.frames import Energyscape

__all__ = ["draw", "draw_on"]

_LEFT_EMS, _RIGHT_EMS, _FLOOR_EMS, _ROOF_EMS = 5.0, 1.5, 4.0, 1.0
_RATIO = 0.42
_X, _Y = "range (m)", "dB re strongest"


def draw(canvas: Canvas, image: Energyscape) -> Figure:
    """Draw level over range."""
    style, em_pt = canvas.style, canvas.style.em_pt
    page, (box,), _ = lay_out(
        style,
        _words.of_image(image),
        [lambda width_pt: _RATIO * width_pt + _FLOOR_EMS * em_pt],
        width_pt=720.0,
        side_pt=0.0,
        below_pt=0.0,
    )
    inner = box.inset(
        left=_LEFT_EMS * em_pt, right=_RIGHT_EMS * em_pt, bottom=_FLOOR_EMS * em_pt, top=_ROOF_EMS * em_pt
    )
    axes = page.axes(inner, x=_X, y=_Y)
    _paint(canvas, axes, image)
    return page.figure


def draw_on(canvas: Canvas, axes: Axes, image: Energyscape) -> None:
    """Draw level over range on given axes."""
    _paint(canvas, axes, image)
    axes.set_xlabel(_X)
    axes.set_ylabel(_Y)


def _paint(canvas: Canvas, axes: Axes, image: Energyscape) -> None:
    style = canvas.style
    axes.plot(image.range_m, canvas.level_db(image.amplitude)[0], color=style.mark, linewidth=style.line_pt)
    axes.margins(x=0.01)
    axes.set_ylim(-canvas.dynamic_range_db, 3.0)
    canvas.grid(axes)
    axes.set_xlim(axes.get_xlim())
    canvas.mark_peaks(axes, lambda peak: (peak.range_m, peak.level_db))
