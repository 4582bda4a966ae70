"""Delays with which the sound from a direction reaches the microphones."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import far_field_delays, microphones, spherical_delays
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["WaveDelays"]


class WaveDelays:
    """Delays of plane waves, or of those around passive.focus_m, at each enabled microphone, with the calibration."""

    def __init__(self, settings: Settings) -> None:
        layout = microphones(settings.array)
        self._positions_m, self._own_s = layout.enabled_positions_m, layout.delay_s[layout.enabled]
        self._speed_m_s, self._focus_m = sound_speed_m_s(settings.air), settings.passive.focus_m

    def __call__(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return delays in s relative to the enabled microphones' centroid: (direction, mic)."""
        if self._focus_m is None:
            delay_s = far_field_delays(self._positions_m, directions, sound_speed_m_s=self._speed_m_s)
        else:
            delay_s = spherical_delays(
                self._positions_m, directions, range_m=self._focus_m, sound_speed_m_s=self._speed_m_s
            )
        return np.asarray(delay_s + self._own_s)
