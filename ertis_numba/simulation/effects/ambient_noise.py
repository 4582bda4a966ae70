"""Diffuse noise from all directions."""

import numpy as np

from ertis_numba.simulation.effects._frames import FRAME, OverlappingFrames, band_bins, drawn, window
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.sources import Ambient

__all__ = ["ambient_noise"]

_OWN = 1e-6  # uncorrelated power of each microphone: without it the matrix is singular below some kilohertz
_NODE_HZ = 2000.0  # frequency step: the coherence of microphones 15 cm apart changes by a few hundredths per step


def ambient_noise(shot: Snapshot, ambient: Ambient, seed: tuple[int, ...]) -> OverlappingFrames:
    """Return a diffuse sound field: independent plane waves of equal level from all directions.

    The coherence of two microphones at a distance d is ``sin(k d) / (k d)`` (R. K. Cook et al., Measurement of
    correlation coefficients in reverberant sound fields, JASA 27, 1955). The Cholesky factor of this matrix mixes
    independent noises at each frequency.
    """
    rate_hz = shot.sensor.recording.sample_rate_hz
    bins = band_bins(ambient.band_hz, rate_hz)
    frequency_hz = bins * rate_hz / FRAME
    places, nodes = np.unique(np.rint(frequency_hz / _NODE_HZ), return_inverse=True)
    # Parts of a large array are rendered one after the other, and must receive parts of one field.
    every = np.flatnonzero(shot.layout.enabled)
    positions_m = shot.layout.positions_m[every]
    apart_m = np.linalg.norm(positions_m[:, None] - positions_m, axis=-1)
    coherence = np.sinc(2 * apart_m / shot.speed_m_s * np.maximum(places, 0.5)[:, None, None] * _NODE_HZ)
    mix = np.linalg.cholesky(coherence + _OWN * np.eye(len(every)))[:, np.searchsorted(every, shot.channels)]
    level = 10 ** (ambient.level_dbfs / 20)
    return OverlappingFrames(seed, lambda random: level * drawn(random, bins, mix[nodes]) * window())
