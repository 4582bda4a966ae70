"""Captions of figures: content, sensor, time and settings."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.units import counted
from ertis_numba.figures.style import angle, minus
from ertis_numba.frames import AcousticMap, Energyscape, Stamp
from ertis_numba.geometry import microphones, observable_angles
from ertis_numba.settings import Settings
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS

__all__ = [
    "Heading",
    "highest_over",
    "khz",
    "left_out",
    "number",
    "of_acoustic_map",
    "of_array",
    "of_image",
    "of_measurement",
    "span",
    "unknown_levels",
]


_FAINT_DB = -100.0
"""Of full scale: about what the noise of one-bit conversion alone has; bits that never change stay below it."""


@dataclass(frozen=True, slots=True)
class Heading:
    """Parts of the title and of the lines below it, which are parted where they fit."""

    title: tuple[str, ...]
    settings: tuple[str, ...]


def of_image(image: Energyscape) -> Heading:
    """Return the words above an energyscape."""
    settings = image.settings
    processing = settings.processing
    seen = observable_angles(settings.array, image)
    if not seen.has_direction(is_planar=image.is_planar):
        directions = "no direction"
    elif len(image.azimuth_rad) == 1:
        azimuth_deg, elevation_deg = np.degrees([image.azimuth_rad[0], image.elevation_rad[0]])
        directions = f"azimuth {angle(azimuth_deg)}, elevation {angle(elevation_deg)}"
    else:
        directions = f"{len(image.azimuth_rad)} directions"
    level = ("directions relative to the horizontal",) if processing.level_directions else ()
    adaptive = f", {BEAMFORMERS[processing.beamformer].title}" if processing.beamformer != "delay_and_sum" else ""
    adaptive += f", {WEIGHTINGS[processing.weighting].title}" if processing.weighting != "none" else ""
    budget_db = settings.accuracy.max_error_db
    taken = "measurement" if image.points is None else "pulse"  # A fused image has measurements of several sensors.
    return Heading(
        ("Energyscape", image.stamp.sensor, f"{taken} {image.stamp.sequence}", *_if_faint(image.amplitude)),
        (
            *_of_sensor(settings, image.stamp),
            directions,
            *((f"array {seen.note}",) if seen.note and image.points is None else ()),
            *level,
            f"{span(image.range_m)} m in {counted(len(image.range_m), 'range')}",
            f"method {processing.method}{adaptive}",
            *((f"error up to {minus(f'{budget_db:g}')} dB",) if processing.method == "fast" else ()),
            f"{minus(f'{settings.air.temperature_c:g}')} °C",
            *filter(None, [image.stamp.utc]),
        ),
    )


def _if_faint(values: NDArray[np.floating]) -> tuple[str, ...]:
    """Return a note on a faint image, whose colours look like those of any picture because they are relative."""
    strongest = float(np.abs(values).max(initial=0.0))
    if not strongest:
        return ("silence: all values are 0",)
    level_db = 20 * math.log10(strongest)
    return (f"the strongest is {minus(f'{level_db:.0f}')} dB of full scale",) if level_db < _FAINT_DB else ()


def of_measurement(title: str, settings: Settings, stamp: Stamp, *parts: str, values: NDArray[np.floating]) -> Heading:
    """Return the words above ``values`` that were recorded."""
    return Heading(
        (title, stamp.sensor, f"measurement {stamp.sequence}", *_if_faint(values)),
        (
            *_of_sensor(settings, stamp),
            *parts,
            f"{minus(f'{settings.air.temperature_c:g}')} °C",
            *filter(None, [stamp.utc]),
        ),
    )


def left_out(masked_s: float) -> tuple[str, ...]:
    """Return the note about the time of a call that is left out, if any."""
    return (f"the first {number(1e3 * masked_s)} ms are left out",) if masked_s else ()


def unknown_levels(offset_db: NDArray[np.float64]) -> tuple[str, ...]:
    """Return the note about source levels that are unknown at some frequencies, if any."""
    return ("without frequencies of which the air absorbs over 60 dB",) if np.isnan(offset_db).any() else ()


def of_acoustic_map(title: str, found: AcousticMap, *parts: str) -> Heading:
    """Return the words above an acoustic map."""
    settings = found.settings
    passive, count = settings.passive, found.n_measurements
    return Heading(
        (title, found.stamp.sensor, f"{'up to ' if count > 1 else ''}measurement {found.stamp.sequence}"),
        (
            settings.array.layout,
            *parts,
            f"method {passive.traits.title}",
            *((f"mean of {count} measurements",) if count > 1 else ()),
            *(() if passive.focus_m is None else (f"focus at {passive.focus_m:g} m",)),
            *left_out(found.masked_s),
            f"{minus(f'{settings.air.temperature_c:g}')} °C",
            *filter(None, [found.stamp.utc]),
        ),
    )


def of_array(settings: Settings, *parts: str) -> Heading:
    """Return the words above an array."""
    layout = microphones(settings.array)
    count, total = int(np.count_nonzero(layout.enabled)), len(layout.enabled)
    some = f"{count} of {total}" if count < total else f"{count}"
    return Heading(
        ("Array and beam pattern", layout.name),
        (
            f"{some} microphone{'s' if total > 1 else ''}",
            *parts,
            f"{_weights(settings)} weights, plane waves",
            f"{minus(f'{settings.air.temperature_c:g}')} °C",
        ),
    )


def _weights(settings: Settings) -> str:
    given = settings.processing.array_weights
    return given if isinstance(given, str) else "listed"


def _of_sensor(settings: Settings, stamp: Stamp) -> tuple[str, str]:
    if stamp.behaviour == "passive":
        return settings.array.layout, "no call"
    call = settings.call
    return (
        settings.array.layout,
        f"call {khz(call.low_frequency_hz)}–{khz(call.high_frequency_hz)} kHz, {number(1e3 * call.duration_s, 6)} ms",
    )


def highest_over(axes: str, *, hidden: bool) -> str:
    """Return the caption of a panel that shows maxima, and whether side lobes are ``hidden``."""
    return f"strongest over {axes}" + (", side lobes dimmed" if hidden else "")


def number(value: float, digits: int = 3) -> str:
    """Return a number to so many digits, of large ones all before the point; never with an exponent."""
    before = math.floor(math.log10(abs(value))) + 1 if value else 1
    return _shortened(f"{value:.{max(0, digits - before)}f}")


def khz(frequency_hz: float) -> str:
    """Return a frequency in kilohertz."""
    return number(frequency_hz / 1e3, 6)


def span(values: NDArray[np.float64]) -> str:
    """Return the first and the last of rising values, to so many decimals that they differ, or the only one."""
    first, last = float(values[0]), float(values[-1])
    fewest = 2 - math.floor(math.log10(abs(last))) if last else 2
    for decimals in range(max(0, fewest), max(0, fewest) + 7):
        low, high = (f"{value:.{decimals}f}" for value in (first, last))
        if low != high:
            return f"{_shortened(low)}–{_shortened(high)}"
    return _shortened(low)


def _shortened(text: str) -> str:
    """Return a number without zeros at the end of its decimals."""
    return text.rstrip("0").rstrip(".") if "." in text else text
