"""Directivity of the emitter as a circular piston."""

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
    """Return the emitter's directivity, that of a piston in a baffle, 0 behind it: (path, mic or 1, frequency)."""
    if not emitter.diameter_m:
        return 1.0
    leaving = paths.leaving[:, :1] if len(paths.targets) and not paths.surface else paths.leaving
    cos = np.einsum("pmx,px->pm", leaving, paths.transmitter.facing)
    return in_baffle(cos, emitter.diameter_m, shot.speed_m_s, frequency_hz)


def estimate(sight: Sight) -> Estimate | None:
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
