"""Noise from everywhere."""

import math

import numpy as np

from ertis_numba.simulation.effects._noise import NoiseField
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.sources import Ambient

__all__ = ["ambient_noise"]

_DIRECTIONS = 128  # an eRTIS array sees the coherence of a diffuse field to 0.3, and to 0.1 on average


def ambient_noise(shot: Snapshot, ambient: Ambient, seed: tuple[int, ...]) -> NoiseField:
    """Return a diffuse field: plane waves from all sides, alike in level and independent.

    Its coherence between two microphones is that of a diffuse field, ``sin(k d) / (k d)`` (R. K. Cook et
    al., Measurement of correlation coefficients in reverberant sound fields, JASA 27, 1955). The directions
    lie on a spiral of equal areas.
    """
    number = np.arange(_DIRECTIONS) + 0.5
    height = 1 - 2 * number / _DIRECTIONS
    azimuth = math.pi * (1 + math.sqrt(5)) * number
    level = np.sqrt(1 - height**2)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], axis=-1)
    delay_s = -(directions @ (shot.ear.positions_m - shot.ear.centre_m).T) / shot.speed_m_s
    return NoiseField(
        seed,
        delay_s=delay_s,
        amplitude=np.full(delay_s.shape, 10 ** (ambient.level_dbfs / 20) / math.sqrt(_DIRECTIONS)),
        band_hz=ambient.band_hz,
        rate_hz=shot.sensor.recording.pdm_rate_hz,
    )
