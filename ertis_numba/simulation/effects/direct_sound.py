"""Microphones hear the emitter beside them."""

from ertis_numba.simulation.paths import Paths, without_target
from ertis_numba.simulation.snapshot import Snapshot, TransmitterPose

__all__ = ["direct_sound"]


def direct_sound(shot: Snapshot, transmitter: TransmitterPose) -> Paths:
    """Return the way from the sensor's own emitter straight to its microphones.

    Its level is the emitter's own, ``direct_sound_db``: it creeps along the housing, for which no pattern of
    the emitter speaks.
    """
    return without_target(transmitter, shot.receiver, shot.targets)
