"""Delays with which the sound from a direction reaches the microphones."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import far_field_delays, microphones, spherical_delays
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive.likelihood import tangents
from ertis_numba.settings import Settings

__all__ = ["WaveDelays"]

_FLAT: Final = 1e-6  # Extent of the microphones relative to the unit of the fit, below which it is none.


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

    def curvatures(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the changes of delays by 1/range, in s m, for sources at a finite range: (2, direction, mic)."""
        out = np.zeros((2, len(directions), len(self._own_s)))
        if self._focus_m is None:
            for k, direction in enumerate(directions):
                across = self._positions_m @ tangents(direction).T
                out[0, k] = (across**2).sum(axis=1) / (2 * self._speed_m_s)
                plane = np.column_stack([across, np.ones(len(across))])
                out[1, k] = out[0, k] - plane @ np.linalg.lstsq(plane, out[0, k], _FLAT)[0]
        return out
