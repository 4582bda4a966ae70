"""Calls of the other sensors of the scene."""

from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["cross_emission"]


def cross_emission(shot: Snapshot) -> list[int]:
    """Return the indices of the other sensors that emit.

    All sensors emit at the same time. The call of another sensor follows a bistatic path from its emitter over a target
    to the microphones.
    """
    return [
        number
        for number, sensor in enumerate(shot.scene.sensors)
        if number != shot.number and not sensor.emitter.silent
    ]
