"""Delays with which the sound from a direction reaches the microphones."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import far_field_delays, microphones, spherical_delays
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["WaveDelays"]


class WaveDelays:
    """Delays of the sound from directions at each enabled microphone, with those of the calibration.

    Parameters
    ----------
    settings : Settings
        Waves are plane, or spherical around sources at ``passive.focus_m``.
    """

    def __init__(self, settings: Settings) -> None:
        layout = microphones(settings.array)
        self._positions_m, self._own_s = layout.enabled_positions_m, layout.delay_s[layout.enabled]
        self._speed_m_s, self._focus_m = sound_speed_m_s(settings.air), settings.passive.focus_m

    def __call__(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return delays relative to the centroid of the enabled microphones in seconds: (direction, mic) float64.

        Parameters
        ----------
        directions : (direction, axis) float64
            Unit vectors towards the sources.
        """
        if self._focus_m is None:
            delay_s = far_field_delays(self._positions_m, directions, sound_speed_m_s=self._speed_m_s)
        else:
            delay_s = spherical_delays(
                self._positions_m, directions, range_m=self._focus_m, sound_speed_m_s=self._speed_m_s
            )
        return np.asarray(delay_s + self._own_s)
