"""Matched-filter output of each microphone: level over range."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from ertis_numba.figures import _words
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._hearing import MicrophoneTraces, echoes
from ertis_numba.figures._page import PageBox, lay_out
from ertis_numba.figures._sampling import join_ranges
from ertis_numba.figures._signals import chosen, row_ticks
from ertis_numba.frames import Measurement

__all__ = ["draw"]

_LEFT_EMS, _RIGHT_EMS, _FLOOR_EMS, _ROOF_EMS = 4.6, 1.4, 4.0, 1.8
_LEVEL = "dB re strongest"
_CURVE_EMS = 14.0
_MAX_PLACES = 1000


def draw(canvas: Canvas, measurement: Measurement, *, microphone: int | None) -> Figure:
    """Draw the mean level over range, and below it a row for each microphone."""
    em_pt = canvas.style.em_pt
    heard = chosen(echoes(measurement), microphone)
    heading = _words.of_measurement(
        "Matched-filter output",
        measurement.settings,
        measurement.stamp,
        *_axis_in_words(heard),
        values=heard.values,
    )
    rows_pt = min(30.0, 8 + 0.8 * len(heard.values)) * em_pt
    below_pt = (_FLOOR_EMS + _ROOF_EMS) * em_pt
    if len(heard.values) == 1:
        page, (box,), _ = lay_out(
            canvas.style,
            heading,
            [lambda width_pt: max(0.35 * width_pt, _CURVE_EMS * em_pt) + below_pt],
            width_pt=720.0,
            side_pt=0.0,
            below_pt=0.0,
        )
        page.caption(box, f"microphone {heard.channels[0]}")
        axes = page.axes(_within(box, em_pt), x="range (m)", y=_LEVEL)
        _curve(canvas, axes, heard)
        return page.figure
    panel_pt = (_CURVE_EMS + 1.0) * em_pt + rows_pt + below_pt
    page, (box,), side = canvas.lay_out(heading, [lambda _: panel_pt], width_pt=720.0)
    inner = _within(box, em_pt)
    # A mean is below the strongest, as microphones differ: both parts of the picture have the same 0 dB.
    page.caption(box, f"mean of {len(heard.values)} microphones, and each of them")
    upper = page.axes(inner.inset(bottom=rows_pt + em_pt), y=_LEVEL)
    _curve(canvas, upper, heard)
    upper.tick_params(labelbottom=False)
    lower = page.axes(PageBox(inner.left, inner.bottom, inner.width, rows_pt), x="range (m)", y="microphone (channel)")
    shown = _rows(canvas, lower, heard)
    row_ticks(lower, heard.channels, height_pt=rows_pt, em_pt=em_pt)
    lower.set_xlim(upper.get_xlim())
    return canvas.side(page, side, shown)


def _axis_in_words(heard: MicrophoneTraces) -> tuple[str, ...]:
    range_m = heard.axis
    every = f" every {_words.number(1e3 * (range_m[1] - range_m[0]), 2)} mm" if len(range_m) > 1 else ""
    return (f"{_words.span(range_m)} m{every}",)


def _within(box: PageBox, em_pt: float) -> PageBox:
    return box.inset(left=_LEFT_EMS * em_pt, right=_RIGHT_EMS * em_pt, bottom=_FLOOR_EMS * em_pt, top=_ROOF_EMS * em_pt)


def _curve(canvas: Canvas, axes: Axes, heard: MicrophoneTraces) -> None:
    """Draw the mean power over range, below the strongest of all microphones."""
    mean = np.sqrt(np.mean(np.square(heard.values, dtype=np.float64), axis=0))
    strongest = float(heard.values.max(initial=0.0)) or 1.0
    floor = strongest * 10 ** (-canvas.dynamic_range_db / 20)
    level_db = 20 * np.log10(np.maximum(mean, floor) / strongest)
    axes.plot(heard.axis, level_db, color=canvas.style.mark, linewidth=0.7 * canvas.style.line_pt, rasterized=True)
    axes.set_ylim(-canvas.dynamic_range_db, 3.0)
    spare_m = 0.0 if len(heard.axis) > 1 else 0.1
    axes.set_xlim(float(heard.axis[0]) - spare_m, float(heard.axis[-1]) + spare_m)
    canvas.grid(axes)


def _rows(canvas: Canvas, axes: Axes, heard: MicrophoneTraces) -> AxesImage:
    """Draw a row for each microphone, the first on top."""
    range_m, level_db = join_ranges(heard.axis, canvas.level_db(heard.values), largest=_MAX_PLACES)
    half_m = float(range_m[-1] - range_m[0]) / max(1, 2 * (len(range_m) - 1)) or 0.05
    rows = len(level_db)
    extent = (float(range_m[0]) - half_m, float(range_m[-1]) + half_m, rows - 0.5, -0.5)
    return canvas.show(axes, level_db[::-1], extent=extent)
