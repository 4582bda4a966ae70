"""Sounds that a calibration can use, and the microphones that hear them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.calibration.advice import how_to_record
from ertis_numba.calibration.channel_order import find_order
from ertis_numba.calibration.sounds import Sound, Source, find_source, hear, identical_channels
from ertis_numba.calibration.wavefronts import Target
from ertis_numba.frames import Measurement
from ertis_numba.geometry import Layout, load_layout, microphones

__all__ = [
    "Heard",
    "Microphones",
    "OtherLayoutError",
    "hear_all",
    "ordered",
    "require_sounds",
    "silent_channels",
    "unclear_channels",
]

MIN_COHERENCE: Final = 0.6
"""Lower for channels that receive other sound, such as overlapping echoes."""
_GOOD_SHARE: Final = 0.85  # Share below which other orders and layouts are tried.
_MIN_SHARE: Final = 0.6  # Share of the microphones that one wavefront must fit.
_MAX_SILENT_POWER: Final = 0.1  # Power of a silent channel around the sound, relative to the median channel.


class OtherLayoutError(DataError):
    """Another shipped layout than that of the settings fits the recordings; finding names both in a clause."""

    def __init__(self, given: str, share: float, layout: str) -> None:
        self.finding = (
            f"layout {given} does not fit the recordings ({share:.0%} of the microphones), but layout {layout} does"
        )
        self.layout = layout
        super().__init__(f"{self.finding}; use layout={layout!r}")


@dataclass(frozen=True, slots=True, eq=False)
class Microphones:
    """Microphones that take part, with the calibration and the places in use."""

    channels: NDArray[np.intp]
    positions_m: NDArray[np.float64]
    delay_s: NDArray[np.float64]

    def part(self, chosen: NDArray[np.bool_]) -> "Microphones":
        """Return some of the microphones."""
        return Microphones(self.channels[chosen], self.positions_m[chosen], self.delay_s[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """Sounds of the usable recordings by their numbers, reasons against the others, and copied channels."""

    sounds: dict[int, Sound]
    rejected: dict[int, str]
    copies: dict[int, int]
    former: Layout


def hear_all(
    recordings: Iterable[Any],
    layout: Layout | str | Path | None,
    target: Target,
    on_progress: Callable[[int], None] | None,
) -> Heard:
    """Return the strongest sounds of all measurements."""
    former: Layout | None = layout if isinstance(layout, Layout) else None
    sounds: dict[int, Sound] = {}
    rejected: dict[int, str] = {}
    copies: dict[int, int] = {}
    for number, measurement in enumerate(_measurements(recordings)):
        checks.instance("recordings", measurement, Measurement, "a recording contains")
        own = microphones(measurement.settings.array)
        if former is None:
            former = own if layout is None else load_layout(str(layout))
        if len(own.enabled) != len(former.enabled):
            raise ArgumentError(
                f"recording {number + 1} has {len(own.enabled)} channels, but layout {former.name} has "
                f"{len(former.enabled)}; choose the layout of the sensor"
            )
        channels = np.flatnonzero(former.enabled)
        try:
            sounds[number] = hear(measurement, channels, former.positions_m[channels], target)
            copies = copies or identical_channels(measurement, channels)
        except DataError as error:
            rejected[number] = str(error)
        if on_progress is not None:
            on_progress(number + 1)
    if former is None:
        raise ArgumentError("there are no measurements to calibrate with; use at least one recording")
    heard = Heard(sounds, rejected, copies, former)
    require_sounds(heard, target)
    return heard


def _measurements(recordings: Iterable[Any]) -> Iterable[Measurement]:
    for item in [recordings] if isinstance(recordings, Measurement) else recordings:
        if isinstance(item, Iterable) and not isinstance(item, str):
            yield from item
        else:
            yield item


def require_sounds(heard: Heard, target: Target) -> None:
    """Raise a `DataError` with advice if no recording is left."""
    if not heard.sounds:
        number, reason = next(iter(heard.rejected.items()))
        others = f", and {len(heard.rejected) - 1} more" if len(heard.rejected) > 1 else ""
        advice = "lower the emission level" if "saturated" in reason else how_to_record(target)
        raise DataError(f"no recording can be used (recording {number + 1}: {reason}{others}); {advice}")


def silent_channels(sounds: dict[int, Sound]) -> NDArray[np.bool_]:
    """Return True for microphones that do not receive the sound in most recordings: (mic,) bool."""
    power = np.stack([sound.arrival.power / np.median(sound.arrival.power) for sound in sounds.values()])
    return np.asarray(np.median(power, axis=0) < _MAX_SILENT_POWER)


def unclear_channels(sounds: dict[int, Sound], max_level_db: float) -> NDArray[np.bool_]:
    """Return True for microphones whose sound differs from the common one in most recordings: (mic,)."""
    coherence = np.stack([sound.arrival.coherence for sound in sounds.values()])
    power = np.stack([sound.arrival.power / np.median(sound.arrival.power) for sound in sounds.values()])
    is_too_loud = np.median(power, axis=0) > 10 ** (max_level_db / 10)
    return np.asarray((np.median(coherence, axis=0) < MIN_COHERENCE) | is_too_loud)


def _sources(heard: Heard, every: Microphones, used: NDArray[np.bool_], target: Target) -> dict[int, Source]:
    """Return the approximate source of each sound."""
    return {
        number: find_source(sound, used, every.positions_m, every.delay_s, target)
        for number, sound in heard.sounds.items()
    }


def ordered(
    heard: Heard, every: Microphones, used: NDArray[np.bool_], target: Target
) -> tuple[Microphones, NDArray[np.float64], str]:
    """Return microphones in the order that fits, their sources, and the name of an unexpected order."""

    def typical(positions_m: NDArray[np.float64]) -> float:
        other = replace(every, positions_m=positions_m[every.channels])
        return float(np.median([source.share for source in _sources(heard, other, used, target).values()]))

    order = ""
    sources = _sources(heard, every, used, target)
    usual = float(np.median([source.share for source in sources.values()]))
    found = find_order(typical, heard.former) if usual < _GOOD_SHARE else None
    if usual < _MIN_SHARE or found is not None:
        if found is None:
            raise DataError(
                f"layout {heard.former.name} does not fit the recordings: one wavefront fits {usual:.0%} of the "
                f"microphones; choose the layout of this sensor, or {how_to_record(target)}"
            )
        order, positions_m = found
        if order.startswith("layout "):
            raise OtherLayoutError(heard.former.name, usual, order.removeprefix("layout "))
        every = replace(every, positions_m=positions_m[every.channels])
        sources = _sources(heard, every, used, target)
    for number, source in sources.items():
        if source.share < _MIN_SHARE:
            heard.rejected[number] = f"one wavefront fits {source.share:.0%} of the microphones, so echoes may overlap"
            del heard.sounds[number]
    require_sounds(heard, target)
    return every, np.array([sources[number].source_m for number in heard.sounds]), order
