"""No time is reported for a wrong result: images are checked before they are timed."""

import math

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.errors import DataError
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.geometry import far_field_delays, microphones, unit_vectors
from ertis_numba.waveform import matched_filter

__all__ = ["MAX_ERROR_DB", "require_exact", "require_same_reflector"]

MAX_ERROR_DB = -30.0
_DIRECTIONS = 5  # checked against the exact image, spread over the grid
_NEAR_RAD = math.radians(5)
_NEAR_M = 0.01
_SAME_LEVEL_DB = 1.5


def require_exact(image: Energyscape, measurement: Measurement, *, max_error_db: float = MAX_ERROR_DB) -> float:
    """Return the error of an image of plane wavefronts in dB; refuse one above ``max_error_db``.

    The referee works in float64, at the PDM rate, with delays that are exact phase shifts.

    Raises
    ------
    DataError
        The image is wrong.
    """
    chosen = np.unique(np.linspace(0, len(image.energy) - 1, _DIRECTIONS + 2).astype(int)[1:-1])
    expected = _exact(image, measurement, chosen)
    difference = np.linalg.norm(image.energy[chosen] - expected)
    error_db = 20 * math.log10(float(difference / np.linalg.norm(expected)))
    if not error_db <= max_error_db:
        raise DataError(
            f"image of {len(image.energy)} directions is {error_db:.1f} dB off the exact one; wanted at most "
            f"{max_error_db:g} dB: the times would be those of a wrong result"
        )
    return error_db


def _exact(image: Energyscape, measurement: Measurement, chosen: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the exact envelopes of some directions: (direction, range) float64."""
    settings = measurement.settings
    layout, speed_m_s = microphones(settings.array), sound_speed_m_s(settings.air)
    rate_hz = settings.recording.sample_rate_hz
    n_fft = scipy.fft.next_fast_len(
        settings.recording.n_samples + math.ceil(2 * settings.call.duration_s * rate_hz), real=True
    )
    matched = matched_filter(settings.call, n_fft=n_fft, rate_hz=rate_hz)
    wave_1_s = 2j * math.pi * (matched.first_bin + np.arange(len(matched.values))) * rate_hz / n_fft
    octets = measurement.words.view(np.uint8).reshape(settings.recording.n_samples, -1)
    delays_s = far_field_delays(
        layout.enabled_positions_m,
        unit_vectors(image.azimuth_rad[chosen], image.elevation_rad[chosen]),
        sound_speed_m_s=speed_m_s,
    )
    beams = np.zeros((len(chosen), len(matched.values)), dtype=np.complex128)
    for mic, channel in enumerate(np.flatnonzero(layout.enabled)):
        bits = (octets[:, channel // 8] >> (channel % 8) & 1) * 2.0 - 1.0
        spectrum = scipy.fft.rfft(bits, n_fft)[matched.first_bin :][: len(matched.values)]
        beams += np.exp(wave_1_s * delays_s[:, mic, None]) * spectrum
    beams *= matched.values / (n_fft * delays_s.shape[1])
    return np.asarray(np.abs(beams @ np.exp(wave_1_s[:, None] * (2 * image.range_m / speed_m_s))))


def require_same_reflector(image: Energyscape, other: Energyscape) -> None:
    """Refuse two images unless the strongest place of one is among the strongest of the other, near by.

    Methods sample pulses differently, so two reflectors of nearly one level may change places.

    Raises
    ------
    DataError
        The other image is weak there.
    """
    direction, distance = np.unravel_index(np.argmax(image.energy), image.energy.shape)
    vectors = unit_vectors(other.azimuth_rad, other.elevation_rad)
    there = unit_vectors(image.azimuth_rad[direction], image.elevation_rad[direction])
    near = np.ix_(vectors @ there > math.cos(_NEAR_RAD), np.abs(other.range_m - image.range_m[distance]) < _NEAR_M)
    ratio = float(np.max(other.energy[near], initial=0.0) / np.max(other.energy))
    level_db = 20 * math.log10(ratio) if ratio else -math.inf
    if not level_db >= -_SAME_LEVEL_DB:
        raise DataError(
            f"strongest reflector of one image, at {image.range_m[distance]:.3f} m, has {level_db:.1f} dB in another; "
            f"wanted at least {-_SAME_LEVEL_DB:g} dB: the times would be those of a wrong result"
        )
