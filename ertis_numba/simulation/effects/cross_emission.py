"""Sensors hear each other's calls."""

from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["cross_emission"]


def cross_emission(shot: Snapshot) -> list[int]:
    """Return the numbers of the other sensors that emit.

    All emit together, so the way of a foreign call is emitter, target, microphone: on an ellipse rather
    than there and back.
    """
    return [
        number
        for number, sensor in enumerate(shot.scene.sensors)
        if number != shot.number and not sensor.emitter.silent
    ]
