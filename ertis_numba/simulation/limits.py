"""Limits of the models of targets."""

import math

import numpy as np

from ertis_numba.simulation.effects.spreading import NEAREST_M
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["exceeded", "near_discs"]


def exceeded(shot: Snapshot) -> list[str]:
    """Return a note for each target that is too near for its model."""
    return [*_on_sensor(shot), *near_discs(shot)]


def _on_sensor(shot: Snapshot) -> list[str]:
    """Return a note for each point or sphere that touches the sensor, whose echo has no meaningful level."""
    targets = shot.targets
    apart_m = np.linalg.norm(targets.positions_m - shot.ear.centre_m, axis=1) - targets.radius_m
    return [
        f"{targets.names[k]} is {'on' if apart_m[k] >= 0 else 'around'} sensor {shot.sensor.name}, within "
        f"{NEAREST_M:g} m; its echo hides all others. Move one of the two"
        for k in np.flatnonzero(apart_m < NEAREST_M)
    ]


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
