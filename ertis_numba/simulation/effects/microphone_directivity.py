"""Directivity of the microphone ports."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.arrivals import EchoPaths
from ertis_numba.simulation.effects._effect import Effect
from ertis_numba.simulation.effects.piston import piston
from ertis_numba.simulation.estimates import Estimate, filtered
from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.sight import Sight

__all__ = ["EFFECT", "microphone_directivity"]


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


def _gain(echoes: EchoPaths) -> NDArray[np.float64] | None:
    diameter_m = echoes.shot.sensor.electronics.microphone_diameter_m
    if not diameter_m:
        return None
    return microphone_directivity(echoes.paths, diameter_m, echoes.frequency_hz, echoes.shot.speed_m_s)


def _estimate(sight: Sight) -> Estimate | None:
    """Compare echoes with those at omnidirectional microphones."""
    diameter_m = sight.shot.sensor.electronics.microphone_diameter_m
    if not (diameter_m and len(sight.heard)):
        return None
    return filtered(
        sight,
        "microphone_directivity",
        f"ports of {1000 * diameter_m:.3g} mm change {{name}} by {{change:.2f}} dB",
    )


EFFECT: Final = Effect(
    name="microphone_directivity",
    about="directivity of the microphone ports",
    equation="the same at the ports",
    source="reciprocity",
    needed_if="ports are not small",
    requested=True,
    weakens=True,
    estimate=_estimate,
    gain=_gain,
)
