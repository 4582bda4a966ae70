"""Diffuse noise from all directions."""

from typing import Final

import numpy as np

from ertis_numba.simulation.effects._effect import Effect, Sound
from ertis_numba.simulation.effects._frames import FRAME, OverlappingFrames, band_bins, drawn, window
from ertis_numba.simulation.estimates import Estimate, noise
from ertis_numba.simulation.sight import Sight
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.sources import Ambient

__all__ = ["EFFECT", "ambient_noise"]

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


def _sounds(shot: Snapshot, seed: tuple[int, ...]) -> list[Sound]:
    ambient = shot.scene.ambient
    return [] if ambient is None else [ambient_noise(shot, ambient, (*seed, 0))]


def _estimate(sight: Sight) -> Estimate | None:
    """Compare diffuse noise with the weakest reflector."""
    ambient = sight.shot.scene.ambient
    if ambient is None:
        return None
    level = sight.of_white_noise(ambient.level_dbfs, band_hz=ambient.band_hz)
    return noise(sight, level, f"{ambient.level_dbfs:g} dBFS at each microphone")


EFFECT: Final = Effect(
    name="ambient_noise",
    about="diffuse noise from all directions",
    equation="plane waves from all sides: coherence sin(k d) / (k d)",
    source="Cook et al., 1955",
    needed_if="it exceeds the noise floor of the image",
    requested=True,
    estimate=_estimate,
    sounds=_sounds,
)
