"""Maxima of images that noise from their direction may have caused, such as a hiss, a tone or clicks."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.noise import echo_floor
from ertis_numba.analysis.point_spread import spread_of
from ertis_numba.frames import Energyscape
from ertis_numba.geometry.air import sound_speed_m_s

__all__ = ["is_short", "pulse_steps", "stands_out"]

_PULSE: Final = 1.0  # Length beside a maximum relative to the resolution in range.
_SHORT: Final = 0.75  # Amplitude there relative to the maximum, to which that of a click hardly falls.
_QUANTILE: Final = 0.8  # Quantile of the amplitudes around a maximum that implies the noise.
_LEAST: Final = 16  # Ranges from which the noise of a direction is estimated at least.


def stands_out(
    image: Energyscape, row: NDArray[np.int64], column: NDArray[np.int64], false_alarm: float, n_pulse: int
) -> NDArray[np.bool_]:
    """Return True for maxima (maximum,) that noise from their direction does not explain."""
    # They exceed the noise of their direction, in the whole record and within the length of the call, and are as short
    # in range as its pulse. The noise of cleaned images is unknown: all of their maxima stand out.
    if not len(row) or len(image.range_m) < _LEAST or image.settings.processing.is_cleaned:
        return np.ones(len(row), np.bool_)
    top = image.amplitude[row, column]
    floor = echo_floor(image, false_alarm)
    if floor.exponent == 1.0:  # Side lobes of other echoes would raise it, unless the beamformer suppresses them.
        floor = floor._replace(by_range=np.zeros_like(floor.by_range))
    (limit,) = floor.at(image.amplitude, row, column, _QUANTILE)
    return np.asarray((top > limit) & is_short(image, row, column, top, n_pulse))


def is_short(
    image: Energyscape, row: NDArray[np.int64], column: NDArray[np.int64], top: NDArray[np.float32], n_pulse: int
) -> NDArray[np.bool_]:
    """Return True for maxima as short as the pulse of the call; those of clicks last as long as the click."""
    beside = np.arange(1, n_pulse + 1)
    columns = column[:, None] + np.concatenate([-beside, beside])
    around = image.amplitude[row[:, None], columns.clip(0, image.amplitude.shape[1] - 1)]
    return np.asarray(around.min(axis=1) < _SHORT * top)


def pulse_steps(image: Energyscape) -> int:
    """Return the number of ranges within which the pulse of an echo falls to a third."""
    frequency_hz, share = spread_of(image.settings).spectrum
    band_hz = math.sqrt(12 * max(float(share @ frequency_hz**2 - (share @ frequency_hz) ** 2), 1.0))
    step_m = float(image.range_m[-1] - image.range_m[0]) / max(1, len(image.range_m) - 1)
    length_m = _PULSE * sound_speed_m_s(image.settings.air) / (2 * band_hz)
    return max(1, min(round(length_m / step_m), len(image.range_m))) if step_m else 1
