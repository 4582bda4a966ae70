"""Contrast of images before and after a calibration, as a test on all the sound of the recordings."""

import math
from collections.abc import Iterable
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.health.arrival import Compressed
from ertis_numba.calibration.sounds import MAX_DIRECT_PATH_M, Sound
from ertis_numba.geometry import Layout, unit_vectors

__all__ = ["image_contrast_db"]

_AZIMUTH_DEG: Final = np.arange(-80.0, 81.0, 5.0)
_ELEVATION_DEG: Final = np.arange(-45.0, 46.0, 15.0)
_MAX_RECORDS: Final = 4


def image_contrast_db(sounds: Iterable[Sound], channels: NDArray[np.intp], layout: Layout) -> float:
    """Return the power of the strongest direction relative to the mean, beyond the direct sound, in dB."""
    azimuth_rad, elevation_rad = (
        grid.ravel() for grid in np.radians(np.meshgrid(_AZIMUTH_DEG, _ELEVATION_DEG, indexing="ij"))
    )
    towards = unit_vectors(azimuth_rad, elevation_rad)
    used = layout.enabled[channels]
    chosen = channels[used]
    highest, mean = 0.0, 0.0
    for sound in list(sounds)[:_MAX_RECORDS]:
        delay_s = layout.delay_s[chosen] - towards @ layout.positions_m[chosen].T / sound.speed_m_s
        power = _beams(sound.pulses, used, delay_s, layout.gain[chosen])
        later = round((MAX_DIRECT_PATH_M / sound.speed_m_s - sound.pulses.start_s) / sound.pulses.step_s)
        per_sample = power.shape[1] / sound.pulses.envelope.shape[1]
        power = power[:, round(max(later, 0) * per_sample) :]
        highest += float(power.max(axis=0).sum())
        mean += float(power.mean(axis=0).sum())
    return 10 * math.log10(highest / mean) if mean else 0.0


def _beams(
    pulses: Compressed, used: NDArray[np.bool_], delay_s: NDArray[np.float64], gain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the power of each beam: (direction, sample) float64, from the time of the first step on."""
    turn = 2j * np.pi * pulses.frequency_hz
    # The record begins where the envelopes begin.
    signals = pulses.bins[used] * np.exp(turn * (pulses.start_s - pulses.origin_s)) / gain[:, None]
    beams = np.empty((len(delay_s), signals.shape[1]), dtype=np.complex64)
    steering = np.exp(turn[0] * delay_s)
    step = np.exp((turn[1] - turn[0]) * delay_s)
    for index in range(len(turn)):
        beams[:, index] = steering @ signals[:, index]
        steering *= step
    made = scipy.fft.ifft(beams, 2 * signals.shape[1], axis=1)
    return np.asarray(made.real**2 + made.imag**2, dtype=np.float64)
