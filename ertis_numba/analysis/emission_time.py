"""Time of the emission in a record, from the direct sound between the emitter and the microphones."""

from collections.abc import Iterable
from typing import Final

import numpy as np

from ertis_numba.air import sound_speed_m_s
from ertis_numba.analysis.health.arrival import compress, strongest
from ertis_numba.analysis.health.emission import fit_emission
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.stages.signals import signals_of

__all__ = ["emission_time_s", "emission_times_s"]

_SEARCHED_S: Final = 0.1  # Direct sound arrives near the start of a record.


def emission_time_s(measurement: Measurement) -> float | None:
    """Return the time of the emission since the start of the record, which is negative if it began before.

    The emitter is at the array's centre. The result is None if the strongest arrival may be an echo, and for arrays
    such as rings, at which direct sound equals an echo from ahead. Saturated direct sound has a result, too.

    Parameters
    ----------
    measurement : Measurement

    Raises
    ------
    DataError
        The samples do not match the settings.
    """
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
    arrived = strongest(found, float(2 * np.linalg.norm(positions_m, axis=1).max()) / speed_m_s)
    if arrived is None:
        return None
    times_s = arrived[0] - layout.delay_s[layout.enabled][sounding]
    return fit_emission(times_s, positions_m[sounding], speed_m_s)


def emission_times_s(measurements: Iterable[Measurement]) -> list[float]:
    """Return the times of the emissions of measurements whose direct sound is clear; none if most are not."""
    times_s = [emission_time_s(each) for each in measurements]
    known = [time_s for time_s in times_s if time_s is not None]
    return known if 2 * len(known) > len(times_s) else []
