"""Layout and beam pattern of an array."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures import _captions
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._marks import name_points
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures.style import LINES, angle
from ertis_numba.geometry import Layout, array_weights, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["Cut", "draw", "pattern_db", "width_deg"]

_MAX_LINES = 5
_LEGEND_LINES = 1.4  # height of its lines, by the size of their letters
_MAX_NAMES = 64
_BAND_WAVES = 17
_STEP_DEG = 0.2
_FINE_DEG = np.geomspace(1e-3, 4.0, 170)  # to either side, 5 % apart: lobes from 0.01° on fall off over many of them
_HALF_POWER_DB = 10 * math.log10(0.5)


@dataclass(frozen=True, slots=True)
class Cut:
    """A line of a beam pattern; frequencies are one, or those whose mean power counts."""

    name: str
    frequencies_hz: tuple[float, ...]


def draw(
    canvas: Canvas,
    settings: Settings,
    *,
    frequencies_hz: Sequence[float] | None,
    azimuth_deg: float,
    elevation_deg: float,
) -> Figure:
    """Draw the layout, and the pattern along azimuth and along elevation."""
    layout, lines = microphones(settings.array), _lines(settings, frequencies_hz)
    low_m, high_m = (edge(layout.enabled_positions_m, axis=0) for edge in (np.min, np.max))
    size_mm = 1e3 * (high_m - low_m)
    deep_mm, wide_mm, tall_mm = map(_captions.number, np.round(size_mm, 6))
    spread = f"aperture {wide_mm} × {tall_mm} mm" + (f", {deep_mm} mm deep" if size_mm[0] > 1e-6 else "")
    beam_deg = {"azimuth": azimuth_deg, "elevation": elevation_deg}
    reported = {axis: f"{axis} {angle(at_deg)}" for axis, at_deg in beam_deg.items()}

    def paint_cut(axes: Axes, axis: str, other: str) -> None:
        sweep_deg = _sweep(beam_deg[axis])
        to_deg = {axis: sweep_deg, other: np.full_like(sweep_deg, beam_deg[other])}
        for number, line in enumerate(lines):
            level_db = pattern_db(settings, line.frequencies_hz, to_deg["azimuth"], to_deg["elevation"], **steering_deg)
            width = width_deg(sweep_deg, level_db, beam_deg[axis])
            label = f"{line.name}: " + ("none" if width is None else f"{_captions.number(width)}°")
            style: dict[str, Any] = {"linestyle": LINES[number % len(LINES)], "linewidth": 1.2 * canvas.style.line_pt}
            axes.plot(sweep_deg, level_db, label=label, **style)
        axes.set_xlabel(f"{axis} (°)")
        axes.set_ylabel("level (dB)")
        _finish(canvas, axes, f"along {axis}, at {reported[other]}", mirrored=axis == "azimuth")

    def height(width_pt: float) -> float:
        return 0.8 * width_pt + (_LEGEND_LINES * (len(lines) + 2) + 1.0) * canvas.style.tick_pt

    steering_deg = {"azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg}
    panels = [
        Panel(
            lambda axes: _paint_layout(canvas, axes, layout),
            height,
            lambda axes: _fit_layout(canvas, axes, layout),
            "microphones, seen from behind",
        ),
        Panel(lambda axes: paint_cut(axes, "azimuth", "elevation"), height),
        Panel(lambda axes: paint_cut(axes, "elevation", "azimuth"), height),
    ]
    heading = _captions.of_array(settings, spread, "steered to " + ", ".join(reported.values()))
    return compose(canvas, heading, panels, width_pt=1080.0)


def pattern_db(
    settings: Settings,
    frequencies_hz: Sequence[float],
    to_azimuth_deg: NDArray[np.float64],
    to_elevation_deg: NDArray[np.float64],
    *,
    azimuth_deg: float,
    elevation_deg: float,
) -> NDArray[np.float64]:
    """Return the level of plane waves from each direction in the beam to one, 0 dB there: (direction,).

    ``mean over f of |Σ_m w_m exp(jk p_m·(u − u₀)) / M|²``, the beam pattern of delay-and-sum with array weights w.
    """
    positions_m = microphones(settings.array).enabled_positions_m
    looks = unit_vectors(np.radians(to_azimuth_deg), np.radians(to_elevation_deg))
    beam = unit_vectors(np.radians(azimuth_deg), np.radians(elevation_deg))
    paths_m = ((looks - beam) @ positions_m.T).astype(np.float32)  # exact to 1e-5 of a period, and twice as fast
    weights = array_weights(settings).astype(np.float32)
    power = np.zeros(len(looks))
    for frequency_hz in frequencies_hz:
        wave_1_m = 2 * math.pi * frequency_hz / sound_speed_m_s(settings.air)
        power += np.abs((np.exp(np.complex64(1j * wave_1_m) * paths_m) * weights).mean(axis=1)) ** 2
    return np.asarray(10 * np.log10(np.maximum(power / len(frequencies_hz), 1e-20)))


def _sweep(at_deg: float) -> NDArray[np.float64]:
    """Return angles from -90 to 90°, rising, finer the nearer to one: large arrays have lobes of few hundredths."""
    even_deg = np.arange(-90.0, 90.0 + _STEP_DEG / 2, _STEP_DEG)
    near_deg = np.concatenate([at_deg - _FINE_DEG, [at_deg], at_deg + _FINE_DEG])
    return np.unique(np.concatenate([even_deg, near_deg[np.abs(near_deg) <= 90.0]]))


def width_deg(angle_deg: NDArray[np.float64], level_db: NDArray[np.float64], at_deg: float) -> float | None:
    """Return the width at half power of the lobe at an angle; None if it does not fall so far on both sides."""
    middle = int(np.argmin(np.abs(angle_deg - at_deg)))
    edges = []
    for side in (slice(middle, None, -1), slice(middle, None)):
        below = np.flatnonzero(level_db[side] < _HALF_POWER_DB)
        if not len(below) or not below[0]:
            return None
        after = int(below[0])
        angles, levels = angle_deg[side][after - 1 : after + 1], level_db[side][after - 1 : after + 1]
        edges.append(float(np.interp(-_HALF_POWER_DB, -levels, angles)))
    return edges[1] - edges[0]


def _lines(settings: Settings, frequencies_hz: Sequence[float] | None) -> list[Cut]:
    """Return the lines to draw: the ends of the call's band and its mean, or the requested frequencies."""
    if frequencies_hz is None:
        low_hz, high_hz = settings.call.low_frequency_hz, settings.call.high_frequency_hz
        band = f"{_captions.khz(low_hz)}–{_captions.khz(high_hz)} kHz"
        waves_hz = tuple(np.linspace(low_hz, high_hz, _BAND_WAVES).tolist())
        ends = [Cut(f"{_captions.khz(frequency_hz)} kHz", (frequency_hz,)) for frequency_hz in (low_hz, high_hz)]
        return [*ends, Cut(f"{band}, mean power", waves_hz)]
    if isinstance(frequencies_hz, int | float | str):
        raise ArgumentError(f"frequencies_hz is {frequencies_hz!r}; pass a list, such as [40e3]")
    if not 1 <= len(frequencies_hz) <= _MAX_LINES:
        raise ArgumentError(f"frequencies_hz holds {len(frequencies_hz)} frequencies; use 1 to {_MAX_LINES}")
    return [
        Cut(f"{_captions.khz(checks.positive('frequencies_hz', frequency_hz))} kHz", (float(frequency_hz),))
        for frequency_hz in frequencies_hz
    ]


def _paint_layout(canvas: Canvas, axes: Axes, layout: Layout) -> None:
    style, seen_mm = canvas.style, 1e3 * layout.positions_m[layout.enabled, 1:]
    size_pt = (5.0 if len(seen_mm) <= _MAX_NAMES else 2.0) * style.line_pt
    axes.plot(*seen_mm.T, "o", color=style.mark, markersize=size_pt, markeredgewidth=0)
    axes.set_xlabel("y, left (mm)")
    axes.set_ylabel("z, up (mm)")
    axes.locator_params(nbins=6)
    canvas.grid(axes)


def _fit_layout(canvas: Canvas, axes: Axes, layout: Layout) -> None:
    """Set limits with one scale for both axes and room around, and name the microphones if they are few."""
    style, on = canvas.style, layout.enabled
    seen_mm, box = 1e3 * layout.positions_m[on, 1:], axes.bbox
    middle, reach = (seen_mm.min(axis=0) + seen_mm.max(axis=0)) / 2, np.ptp(seen_mm, axis=0)
    scale = 1.25 * max(reach[0] / box.width, reach[1] / box.height) or 20 / box.width
    axes.set_xlim(middle[0] + scale * box.width / 2, middle[0] - scale * box.width / 2)
    axes.set_ylim(middle[1] - scale * box.height / 2, middle[1] + scale * box.height / 2)
    if len(seen_mm) <= _MAX_NAMES:
        names = [str(channel) for channel in np.flatnonzero(on)]
        points = [(float(y), float(z)) for y, z in seen_mm]
        name_points(axes, style, points, names, ring_pt=3.5 * style.line_pt, colour=style.faint)


def _finish(canvas: Canvas, axes: Axes, title: str, *, mirrored: bool) -> None:
    style, floor_db = canvas.style, -canvas.dynamic_range_db
    axes.axhline(_HALF_POWER_DB, color=style.faint, linewidth=0.6 * style.line_pt, alpha=0.6)
    axes.set_xlim(90, -90) if mirrored else axes.set_xlim(-90, 90)
    axes.set_ylim(floor_db, 3.0)
    axes.set_xticks(range(-90, 91, 30))
    step = max(1.0, 10.0 * round(-floor_db / 50))
    axes.set_yticks(np.arange(0.0, floor_db - 1e-9, -step))
    canvas.grid(axes)
    above: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "borderaxespad": 0.4}
    legend = axes.legend(title=f"{title}\nhalf-power width", borderpad=0.2, labelspacing=0.25, frameon=False, **above)
    legend.get_title().set_multialignment("center")
