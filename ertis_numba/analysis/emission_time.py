"""Time of the emission in a record, from the direct sound between the emitter and the microphones."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from ertis_numba.analysis.health.arrival import compress, strongest
from ertis_numba.analysis.health.emission import describe_shift, fit_emission
from ertis_numba.chain.signals import signals_of
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s

__all__ = ["EmissionTimes", "describe_start", "emission_time_s", "emissions_of"]

_SEARCHED_S: Final = 0.1  # Direct sound arrives near the start of a record.
_MAX_EMISSIONS: Final = 3
_EQUALLY_LOUD: Final = 0.5  # Peak of another emission relative to the strongest one.


class EmissionTimes(NamedTuple):
    """First emission since the start of a record, negative if before, and the time until the next one, or None."""

    first_s: float
    interval_s: float | None


def emission_time_s(measurement: Measurement) -> float | None:
    """Return the time of the first emission since the start of the record, as `emissions_of` does."""
    found = emissions_of(measurement)
    return None if found is None else found.first_s


def emissions_of(measurement: Measurement) -> EmissionTimes | None:
    """Return the emissions whose direct sound the first 0.1 s of a record contain."""
    # None if it may be an echo, and for arrays such as rings, at which direct sound equals an echo from ahead.
    settings = measurement.settings
    layout, speed_m_s = microphones(settings.array), sound_speed_m_s(settings.air)
    positions_m = layout.enabled_positions_m
    signals = signals_of(measurement, max_samples=round(_SEARCHED_S * settings.recording.sample_rate_hz))
    sounding = np.flatnonzero(np.ptp(signals, axis=1) > 0)
    if len(sounding) < 3:
        return None
    found = compress(
        lambda row: signals[row],
        sounding.tolist(),
        settings.call,
        rate_hz=settings.signal_rate_hz,
        first=0,
        last=signals.shape[1],
    )
    width_s = float(2 * np.linalg.norm(positions_m, axis=1).max()) / speed_m_s
    loudest = float(np.median(found.envelope.max(axis=1)))
    at_s: list[float] = []
    while len(at_s) < _MAX_EMISSIONS and np.median(found.envelope.max(axis=1)) > _EQUALLY_LOUD * loudest:
        arrived = strongest(found, width_s)
        times_s = None if arrived is None else arrived[0] - layout.delay_s[layout.enabled][sounding]
        emission_s = None if times_s is None else fit_emission(times_s, positions_m[sounding], speed_m_s)
        if arrived is None or emission_s is None:
            break
        at_s.append(emission_s)
        seconds = found.start_s + np.arange(found.envelope.shape[1]) * found.step_s
        is_near = np.abs(seconds - arrived[1]) <= settings.call.duration_s + 2 * width_s
        found = replace(found, envelope=np.where(is_near, 0.0, found.envelope))
    if not at_s:
        return None
    first_s, *later_s = sorted(at_s)
    return EmissionTimes(first_s, later_s[0] - first_s if later_s else None)


def describe_start(
    emissions: Iterable[EmissionTimes | None], speed_m_s: float, *, delay_s: float = 0.0
) -> tuple[str, str] | None:
    """Return a text about records that do not begin with their only emission, and a remedy; None if all do."""
    every = list(emissions)
    known = [each for each in every if each is not None]
    if 2 * len(known) <= len(every):
        return None
    intervals_s = [each.interval_s for each in known if each.interval_s is not None]
    if 2 * len(intervals_s) > len(known):
        interval_s = float(np.median(intervals_s))
        text = f"a record contains several emissions, {1e3 * interval_s:.4g} ms apart; the later ones look like echoes"
        length = f"import again with --length {round(interval_s, 6):g}"
        return text, f"end each record before the next emission, or {length}"
    return describe_shift([each.first_s for each in known], speed_m_s, delay_s=delay_s)
