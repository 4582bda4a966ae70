"""Calls of the other sensors of the scene."""

import numpy as np

from ertis_numba.simulation.estimates import Estimate, ghosts
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["estimate", "other_emitters"]


def other_emitters(shot: Snapshot) -> list[int]:
    """Return the indices of the other sensors that emit."""
    return [
        number
        for number, sensor in enumerate(shot.scene.sensors)
        if number != shot.number and not sensor.emitter.silent
    ]


def estimate(sight: Sight) -> Estimate | None:
    """Find the strongest arrival of another sensor's call, including paths over walls."""
    if len(sight.shot.scene.sensors) == 1 or not other_emitters(sight.shot):
        return None
    more = sight.echoes(sight.active | {"cross_emission", *(["walls"] if sight.shot.mirrors else [])})
    own = sight.shot.sensor.name
    foreign = np.array([_emitter(name, own) != own for name in more.names], dtype=np.bool_)
    return ghosts(sight, more, foreign, "{name} appears at {range:.2f} m, {level:+.1f} dB relative to the image there")


def _emitter(name: str, own: str) -> str:
    """Return the name of the sensor whose call an echo is."""
    sensor, colon, _ = name.partition(": ")
    return sensor if colon else own
