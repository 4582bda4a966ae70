"""Directivity of the emitter as a circular piston."""

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

__all__ = ["EFFECT", "emitter_directivity"]


def emitter_directivity(
    paths: Paths, diameter_m: float, frequency_hz: NDArray[np.float64], speed_m_s: float
) -> NDArray[np.float64]:
    """Return the emitter's directivity towards the paths: (path, mic, frequency) float64.

    The model is a circular piston in a baffle, ``2 J₁(v) / v`` with ``v = π d f sin θ / c``, and 0 behind it. The
    second axis has length 1 if all microphones share the direction to the target.
    """
    leaving = paths.leaving[:, :1] if len(paths.targets) and not paths.surface else paths.leaving
    cos = leaving @ paths.transmitter.facing
    sin = np.sqrt(np.maximum(1 - cos**2, 0.0))
    pattern = piston(math.pi * diameter_m / speed_m_s * sin[..., None] * frequency_hz)
    return np.asarray(np.where(cos[..., None] >= 0, pattern, 0.0))


def _gain(echoes: EchoPaths) -> NDArray[np.float64] | None:
    diameter_m = echoes.emitter.diameter_m
    if not diameter_m:
        return None
    return emitter_directivity(echoes.paths, diameter_m, echoes.frequency_hz, echoes.shot.speed_m_s)


def _estimate(sight: Sight) -> Estimate | None:
    """Compare echoes with those of omnidirectional emitters."""
    sensors = sight.shot.scene.sensors
    diameter_m = max((sensors[number].emitter.diameter_m for number in sight.emitters(sight.active)), default=0.0)
    if not (diameter_m and len(sight.heard)):
        return None
    return filtered(
        sight,
        "emitter_directivity",
        f"a piston of {1000 * diameter_m:.3g} mm changes {{name}} by {{change:.2f}} dB",
    )


EFFECT: Final = Effect(
    name="emitter_directivity",
    about="directivity of the emitter as a circular piston",
    equation="2 J₁(v) / v, v = π d f sin θ / c, nothing behind",
    source="Kinsler et al., section 7.4",
    needed_if="echoes lie off the axis",
    requested=True,
    weakens=True,
    estimate=_estimate,
    gain=_gain,
)
