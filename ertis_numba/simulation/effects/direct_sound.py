"""Microphones hear the emitter beside them."""

from ertis_numba.simulation.paths import Paths, without_target
from ertis_numba.simulation.snapshot import Mouth, Snapshot

__all__ = ["direct_sound"]


def direct_sound(shot: Snapshot, mouth: Mouth) -> Paths:
    """Return the way from the sensor's own emitter straight to its microphones.

    Its level is the emitter's own, ``direct_sound_db``: it creeps along the housing, for which no pattern of
    the emitter speaks.
    """
    return without_target(mouth, shot.ear, shot.targets)
