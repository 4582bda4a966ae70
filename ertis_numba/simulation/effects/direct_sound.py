"""Direct sound from the emitter to its own microphones."""

from ertis_numba.simulation.paths import Paths, without_target
from ertis_numba.simulation.snapshot import Snapshot, TransmitterPose

__all__ = ["direct_sound"]


def direct_sound(shot: Snapshot, transmitter: TransmitterPose) -> Paths:
    """Return the direct path from the sensor's own emitter to its microphones.

    Its level is a separate setting, ``direct_sound_db``. The sound travels along the housing, so the emitter's
    directivity does not apply.
    """
    return without_target(transmitter, shot.receiver, shot.targets)
