"""Directivity of the microphone ports."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.effects._piston import in_baffle
from ertis_numba.simulation.estimates import Estimate, filtered
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.sensors import Emitter
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["estimate", "gain"]


def gain(
    shot: Snapshot, paths: Paths, emitter: Emitter, frequency_hz: NDArray[np.float64]
) -> NDArray[np.float64] | float:
    """Return the microphones' directivity, by reciprocity that of a piston in a baffle: (path, mic, frequency)."""
    diameter_m = shot.sensor.electronics.microphone_diameter_m
    if not diameter_m:
        return 1.0
    cos = -np.einsum("pmx,px->pm", paths.arriving, paths.receiver.axes[:, 0])
    return in_baffle(cos, diameter_m, shot.speed_m_s, frequency_hz)


def estimate(sight: Sight) -> Estimate | None:
    """Compare echoes with those at omnidirectional microphones."""
    diameter_m = sight.shot.sensor.electronics.microphone_diameter_m
    if not (diameter_m and len(sight.heard)):
        return None
    return filtered(
        sight,
        "microphone_directivity",
        f"ports of {1000 * diameter_m:.3g} mm change {{name}} by {{change:.2f}} dB",
    )
