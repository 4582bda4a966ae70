"""Delays with which the sound from a direction reaches the microphones."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.geometry import far_field_delays, microphones, spherical_delays
from ertis_numba.settings import Settings

__all__ = ["wave_delays"]


def wave_delays(settings: Settings, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the delays of the sound from directions at each enabled microphone, with those of the calibration.

    Parameters
    ----------
    settings : Settings
        Waves are plane, or spherical around sources at ``passive.focus_m``.
    directions : (direction, axis) float64
        Unit vectors towards the sources.

    Returns
    -------
    (direction, mic) float64
        Delays relative to the centroid of the enabled microphones, in seconds.
    """
    layout = microphones(settings.array)
    speed_m_s, focus_m = sound_speed_m_s(settings.air), settings.passive.focus_m
    if focus_m is None:
        delay_s = far_field_delays(layout.enabled_positions_m, directions, sound_speed_m_s=speed_m_s)
    else:
        delay_s = spherical_delays(layout.enabled_positions_m, directions, range_m=focus_m, sound_speed_m_s=speed_m_s)
    return np.asarray(delay_s + layout.delay_s[layout.enabled])
