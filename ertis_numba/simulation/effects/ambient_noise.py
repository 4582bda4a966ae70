"""Noise from everywhere."""

import numpy as np

from ertis_numba.simulation.effects._frames import FRAME, Frames, band_bins, drawn, window
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.sources import Ambient

__all__ = ["ambient_noise"]

_NODE_HZ = 2000.0  # coherence of microphones 15 cm apart changes by a few hundredths from one to the next


def ambient_noise(shot: Snapshot, ambient: Ambient, seed: tuple[int, ...]) -> Frames:
    """Return a diffuse field: plane waves from all sides, alike in level and independent.

    Of two microphones d apart its coherence is ``sin(k d) / (k d)`` (R. K. Cook et al., Measurement of correlation
    coefficients in reverberant sound fields, JASA 27, 1955). Independent noises are mixed by the root of
    that matrix, frequency by frequency.
    """
    rate_hz = shot.sensor.recording.pdm_rate_hz
    bins = band_bins(ambient.band_hz, rate_hz)
    frequency_hz = bins * rate_hz / FRAME
    places, nodes = np.unique(np.rint(frequency_hz / _NODE_HZ), return_inverse=True)
    positions_m = shot.ear.positions_m
    apart_m = np.linalg.norm(positions_m[:, None] - positions_m, axis=-1)
    coherence = np.sinc(2 * apart_m / shot.speed_m_s * np.maximum(places, 0.5)[:, None, None] * _NODE_HZ)
    power, vectors = np.linalg.eigh(coherence)
    mix = vectors * np.sqrt(np.maximum(power, 0.0))[:, None, :] @ vectors.transpose(0, 2, 1)
    level = 10 ** (ambient.level_dbfs / 20)
    return Frames(seed, lambda random: level * drawn(random, bins, mix[nodes]) * window())
