"""Samples of one echo, which the hard cases then corrupt."""

import math

import numpy as np

from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from tests.cases import words_of


def echo_signals(settings, *, azimuth_deg, range_m, level, spherical=False):
    """One echo of the call at each microphone: (mic, sample) float64.

    The wave is plane, or spherical from a point that the call reached from the array's centre.
    """
    speed_m_s = sound_speed_m_s(settings.air)
    positions_m = microphones(settings.array).enabled_positions_m
    direction = unit_vectors(np.float64(math.radians(azimuth_deg)), np.float64(0))
    if spherical:
        later_s = (np.linalg.norm(range_m * direction - positions_m, axis=1) - range_m) / speed_m_s
    else:
        later_s = -(positions_m @ direction) / speed_m_s
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    return level * call_at(settings.call, time_s - (2 * range_m / speed_m_s + later_s)[:, None])


def echo_words(settings, **echo):
    """One echo of the call, converted to bits by `words_of`: (sample,) uint32."""
    return words_of(echo_signals(settings, **echo))
