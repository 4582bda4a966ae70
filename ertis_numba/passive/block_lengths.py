"""Length of the blocks whose spectra acoustic maps use: short for many blocks, and long for large arrays."""

import math
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["BINS_OF_A_BAND", "block_length", "block_warning", "spacing_of"]

BINS_OF_A_BAND: Final = 3
"""Least number of bins in a band by default."""
_MAX_SPACING_HZ: Final = 1e3
_LEAST_BLOCKS: Final = 4.0  # in a short record, unless bands are narrow
_TRANSITS: Final = 3.0  # Least length of a block relative to the time in which sound crosses the array by default …
_LEAST_TRANSITS: Final = 2.0  # … and at all: levels are then 0.3 dB too low, and bearings as exact as stated.


def spacing_of(settings: Settings, bands_hz: NDArray[np.float64]) -> float:
    """Return the largest spacing of the bins in hertz, the inverse of the least length of a block."""
    if settings.passive.resolution_hz is not None:
        return settings.passive.resolution_hz
    widest_hz = 1 / max(_TRANSITS * _transit_s(settings), 1 / _MAX_SPACING_HZ)
    of_record_hz = _LEAST_BLOCKS / settings.recording.duration_s
    return min(float(np.diff(bands_hz).min()) / BINS_OF_A_BAND, max(widest_hz, of_record_hz))


def block_length(n_samples: int) -> int:
    """Return the length of the shortest block with an even, fast transform that has at least so many samples."""
    n_block = int(scipy.fft.next_fast_len(n_samples, real=True))
    return n_block + n_block % 2


def block_warning(settings: Settings, bands_hz: NDArray[np.float64]) -> str | None:
    """Return a warning if sound crosses the array in more than half of a block; None if it does not."""
    block_s, transit_s = 1 / spacing_of(settings, bands_hz), _transit_s(settings)
    if block_s >= _LEAST_TRANSITS * transit_s:
        return None
    wanted_hz, duration_s = 1 / (_TRANSITS * transit_s), settings.recording.duration_s
    digits = 1 - math.floor(math.log10(wanted_hz))
    remedy = f"use passive.resolution_hz up to {math.floor(wanted_hz * 10.0**digits) / 10.0**digits:g}"
    if _TRANSITS * transit_s > duration_s:
        remedy = f"use measurements of at least {math.ceil(1e3 * _TRANSITS * transit_s)} ms"
    return (
        f"blocks last {1e3 * block_s:.2g} ms, but sound takes up to {1e3 * transit_s:.2g} ms to cross the array, so "
        f"levels are too low, and directions may be wrong; {remedy}"
    )


def _transit_s(settings: Settings) -> float:
    """Return the time in which sound crosses the array."""
    places_m = microphones(settings.array).enabled_positions_m
    apart_m = scipy.spatial.distance.pdist(places_m).max(initial=0.0)
    return float(apart_m) / sound_speed_m_s(settings.air)
