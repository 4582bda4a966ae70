"""Residuals and beam pattern before and after a calibration."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ertis_numba.base.units import counted
from ertis_numba.calibration import Calibration
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._captions import Heading
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures.style import LINES, angle
from ertis_numba.geometry import Layout, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["draw"]

_WAVES = 17
_STEP_DEG = 0.5
_NAMES = ("before", "after")


def draw(canvas: Canvas, made: Calibration, settings: Settings, *, azimuth_deg: float, elevation_deg: float) -> Figure:
    """Draw the residuals of times and levels of each channel, and the beam pattern along azimuth."""
    residuals = made.residuals
    times_us = [1e6 * residuals.before_time_s, 1e6 * residuals.after_time_s]
    levels_db = [residuals.before_level_db, residuals.after_level_db]

    def paint_pattern(axes: Axes) -> None:
        sweep_deg = np.arange(-90.0, 90.0 + _STEP_DEG / 2, _STEP_DEG)
        patterns = [
            _pattern(made, layout, settings, sweep_deg, azimuth_deg, elevation_deg)
            for layout in (made.former, made.layout)
        ]
        highest = float(patterns[1].max())
        for number, (name, power) in enumerate(zip(_NAMES, patterns, strict=True)):
            level_db = 10 * np.log10(np.maximum(power / highest, 1e-20))
            style: dict[str, Any] = {"linestyle": LINES[1 - number], "linewidth": 1.2 * canvas.style.line_pt}
            axes.plot(sweep_deg, level_db, label=name, **style)
        axes.set_xlim(90, -90)
        axes.set_xticks(range(-90, 91, 30))
        axes.set_ylim(-canvas.dynamic_range_db, 3.0)
        axes.set_xlabel("azimuth (°)")
        axes.set_ylabel("level (dB)")
        _legend(axes, f"beam at azimuth {angle(azimuth_deg)}, elevation {angle(elevation_deg)}")
        canvas.grid(axes)

    def height(width_pt: float) -> float:
        return 0.8 * width_pt + 4.0 * canvas.style.tick_pt

    panels = [
        Panel(lambda axes: _paint_residuals(canvas, axes, made.channels, times_us, "time (µs)"), height),
        Panel(lambda axes: _paint_residuals(canvas, axes, made.channels, levels_db, "level (dB)"), height),
        Panel(paint_pattern, height),
    ]
    fit = (
        f"RMS {1e6 * residuals.before_s:.2f} µs and {residuals.before_db:.2f} dB before, "
        f"{1e6 * residuals.after_s:.2f} µs and {residuals.after_db:.2f} dB after"
    )
    found = "; ".join(made.findings) or "no faults found"
    heading = Heading(
        ("Calibration", made.former.name),
        (
            f"{counted(len(made.source_m), 'recording')}, {counted(len(made.channels), 'microphone')}",
            fit,
            found,
        ),
    )
    return compose(canvas, heading, panels, width_pt=1080.0)


def _paint_residuals(
    canvas: Canvas, axes: Axes, channels: tuple[int, ...], values: list[NDArray[np.float64]], quantity: str
) -> None:
    style = canvas.style
    for number, (name, each) in enumerate(zip(_NAMES, values, strict=True)):
        rows, columns = np.nonzero(np.isfinite(each))
        axes.plot(
            np.asarray(channels)[columns] + (0.2 if number else -0.2),
            each[rows, columns],
            "." if number else "x",
            label=name,
            markersize=4.0 * style.line_pt,
            markeredgewidth=0.6 * style.line_pt,
        )
    axes.axhline(0.0, color=style.faint, linewidth=0.6 * style.line_pt, alpha=0.6)
    axes.set_xlabel("channel")
    axes.set_ylabel(f"residual {quantity}")
    _legend(axes, f"{quantity.partition(' ')[0]} of each recording")
    canvas.grid(axes)


def _legend(axes: Axes, title: str) -> None:
    above: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "borderaxespad": 0.4, "ncols": 2}
    axes.legend(title=title, borderpad=0.2, labelspacing=0.25, frameon=False, **above)


def _pattern(
    made: Calibration,
    layout: Layout,
    settings: Settings,
    to_azimuth_deg: NDArray[np.float64],
    azimuth_deg: float,
    elevation_deg: float,
) -> NDArray[np.float64]:
    """Return the power of plane waves in the beam of a layout, if the calibrated one is true: (direction,) float64."""
    channels, real, call = list(made.channels), made.layout, settings.call
    pace_s_m = 1 / sound_speed_m_s(settings.air)
    looks = unit_vectors(np.radians(to_azimuth_deg), np.full(len(to_azimuth_deg), math.radians(elevation_deg)))
    beam = unit_vectors(np.radians(azimuth_deg), np.radians(elevation_deg))
    arriving_s = real.delay_s[channels] - looks @ real.positions_m[channels].T * pace_s_m
    expected_s = layout.delay_s[channels] - layout.positions_m[channels] @ beam * pace_s_m
    ratio = real.gain[channels] / layout.gain[channels]
    power = np.zeros(len(looks))
    for frequency_hz in np.linspace(call.low_frequency_hz, call.high_frequency_hz, _WAVES):
        power += np.abs(np.exp(-2j * math.pi * frequency_hz * (arriving_s - expected_s)) @ ratio) ** 2
    return power
