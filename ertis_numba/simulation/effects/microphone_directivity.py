"""Directivity of the microphone ports."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.effects.piston import piston
from ertis_numba.simulation.paths import Paths

__all__ = ["microphone_directivity"]


def microphone_directivity(
    paths: Paths, diameter_m: float, frequency_hz: NDArray[np.float64], speed_m_s: float
) -> NDArray[np.float64]:
    """Return the microphones' directivity towards the paths: (path, mic, frequency) float64.

    By reciprocity the model is a circular piston in a baffle, ``2 J₁(v) / v`` with ``v = π d f sin θ / c``, and 0 from
    behind.
    """
    cos = -paths.arriving @ paths.receiver.axes[0]
    sin = np.sqrt(np.maximum(1 - cos**2, 0.0))
    pattern = piston(math.pi * diameter_m / speed_m_s * sin[..., None] * frequency_hz)
    return np.asarray(np.where(cos[..., None] >= 0, pattern, 0.0))
