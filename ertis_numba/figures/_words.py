"""What pictures say above themselves: what is seen, of which sensor, when, and with which settings."""

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings

__all__ = ["Heading", "angle", "minus", "of_array", "of_image", "of_measurement"]


@dataclass(frozen=True, slots=True)
class Heading:
    """Parts of the title and of the lines below it, which are parted where they fit."""

    title: tuple[str, ...]
    settings: tuple[str, ...]


def of_image(image: Energyscape) -> Heading:
    """Return the words above an energyscape."""
    settings = image.settings
    processing = settings.processing
    if len(image.azimuth_rad) == 1:
        azimuth_deg, elevation_deg = np.degrees([image.azimuth_rad[0], image.elevation_rad[0]])
        directions = f"azimuth {angle(azimuth_deg)}, elevation {angle(elevation_deg)}"
    else:
        directions = f"{len(image.azimuth_rad)} directions"
    adaptive = "" if processing.beamformer == "delay_and_sum" else f", {processing.beamformer.replace('_', ' ')}"
    budget_db = settings.accuracy.max_error_db
    return Heading(
        ("Energyscape", image.stamp.sensor, f"measurement {image.stamp.sequence}"),
        (
            *_of_sensor(settings),
            directions,
            f"{image.range_m[0]:.3g}–{image.range_m[-1]:.3g} m in {len(image.range_m)} ranges",
            f"method {processing.method}{adaptive}",
            *((f"error up to {minus(f'{budget_db:g}')} dB",) if processing.method == "fast" else ()),
            f"{minus(f'{settings.air.temperature_c:g}')} °C",
            *_time(image.stamp),
        ),
    )


def of_measurement(what: str, settings: Settings, stamp: Stamp, *parts: str) -> Heading:
    """Return the words above what was recorded."""
    return Heading(
        (what, stamp.sensor, f"measurement {stamp.sequence}"),
        (
            *_of_sensor(settings),
            *parts,
            f"{minus(f'{settings.air.temperature_c:g}')} °C",
            *_time(stamp),
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
            "uniform weights, plane waves",
            f"{minus(f'{settings.air.temperature_c:g}')} °C",
        ),
    )


def _of_sensor(settings: Settings) -> tuple[str, str]:
    call = settings.call
    return (
        settings.array.layout,
        f"call {call.low_frequency_hz / 1e3:g}–{call.high_frequency_hz / 1e3:g} kHz, {call.duration_s * 1e3:g} ms",
    )


def _time(stamp: Stamp) -> tuple[str, ...]:
    """Return when it was, if that is known."""
    if not stamp.timestamp_ns:
        return ()
    seconds, nanoseconds = divmod(stamp.timestamp_ns, 10**9)
    try:
        moment = datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, OSError, ValueError):  # a clock that was never set
        return ()
    return (f"{moment:%Y-%m-%d %H:%M:%S}.{nanoseconds // 10**6:03d} UTC",)


def angle(degrees: float) -> str:
    """Return an angle with its sign, as the axes write it."""
    text = minus(f"{degrees:+.1f}".removesuffix(".0"))
    return "0°" if text in {"+0", "−0"} else f"{text}°"


def minus(text: str) -> str:
    """Return a number with the sign that printers use."""
    return text.replace("-", "−")
