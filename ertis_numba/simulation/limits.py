"""Limits of the models of targets."""

import math

import numpy as np

from ertis_numba.simulation.effects.spreading import NEAREST_M
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["near_discs", "near_targets"]


def near_targets(shot: Snapshot) -> list[str]:
    """Return a note for each target or source so near an emitter or a microphone that amplitudes no longer grow."""
    scene, sensor = shot.scene, shot.sensor
    ends_m = np.concatenate([shot.ear.positions_m, shot.mouth.position_m[None]])
    targets = shot.targets
    things = [(name, place) for name, place in zip(targets.names, targets.positions_m, strict=True)]
    for kind in ("tones", "noises", "sonars"):
        sources = enumerate(getattr(scene, kind))
        things += [(f"{kind}[{number}]", source.position_at(shot.time_s)) for number, source in sources]
    found = []
    for name, place in things:
        apart_m = float(np.min(np.linalg.norm(ends_m - place, axis=1)))
        if apart_m < NEAREST_M:
            found.append(
                f"{name} is {1e3 * apart_m:.2g} mm from an emitter or a microphone of {sensor.name} at "
                f"{shot.time_s:.3g} s; its level is that at {1e3 * NEAREST_M:g} mm. Move it away from the sensor"
            )
    return found


def near_discs(shot: Snapshot) -> list[str]:
    """Return a note for each disc too near for Fresnel's approximation.

    The next term, a phase of ``k a⁴ / (4 r³)`` at the edge of a disc of radius a, must not exceed an eighth of a turn.
    """
    targets = shot.targets
    wave = 2 * math.pi * shot.sensor.call.high_frequency_hz / shot.speed_m_s
    apart_m = np.linalg.norm(targets.positions_m - shot.ear.centre_m, axis=1)
    least_m = np.cbrt(wave * (targets.diameter_m / 2) ** 4 / math.pi)
    return [
        f"{targets.names[k]} is a disc of {targets.diameter_m[k]:g} m at {apart_m[k]:.2g} m from {shot.sensor.name}; "
        f"its echo is accurate from {least_m[k]:.2g} m on. Make it smaller, move it away, or use a wall with size_m"
        for k in np.flatnonzero((targets.diameter_m > 0) & (apart_m < least_m))
    ]
