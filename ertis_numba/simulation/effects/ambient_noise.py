"""Diffuse noise from all directions."""

from collections.abc import Set as AbstractSet

import numpy as np

from ertis_numba.simulation.effects._overlapping_noise import FRAME, OverlappingFrames, band_bins, drawn, window
from ertis_numba.simulation.estimates import Estimate, noise
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["estimate", "loudness", "sounds"]

_OWN = 1e-6  # uncorrelated power of each microphone: without it the matrix is singular below some kilohertz
_ACROSS = 8192  # frequencies at which the noise is summed
_NODE_HZ = 2000.0  # frequency step: the coherence of microphones 15 cm apart changes by a few hundredths per step


def sounds(shot: Snapshot, active: AbstractSet[str], seed: tuple[int, ...]) -> list[OverlappingFrames]:
    """Return a diffuse sound field: independent plane waves of equal level from all directions.

    The coherence of two microphones at a distance d is ``sin(k d) / (k d)`` (R. K. Cook et al., Measurement of
    correlation coefficients in reverberant sound fields, JASA 27, 1955). The Cholesky factor of this matrix mixes
    independent noises at each frequency.
    """
    ambient = shot.scene.ambient
    if ambient is None:
        return []
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
    return [OverlappingFrames((*seed, 0), lambda random: level * drawn(random, bins, mix[nodes]) * window())]


def loudness(shot: Snapshot, active: AbstractSet[str]) -> tuple[float, float]:
    """Return no peak, and the power of the noise."""
    ambient = shot.scene.ambient
    return 0.0, 0.0 if ambient is None else 10 ** (ambient.level_dbfs / 10)


def estimate(sight: Sight) -> Estimate | None:
    """Compare diffuse noise with the weakest reflector."""
    ambient = sight.shot.scene.ambient
    if ambient is None:
        return None
    across_hz = np.linspace(*ambient.band_hz, _ACROSS)
    level = sight.of_white_noise(ambient.level_dbfs, band=(across_hz, np.ones(_ACROSS)))
    return noise(sight, level, f"{ambient.level_dbfs:g} dBFS at each microphone")
