"""Mirror images of emitters and targets in walls."""

from ertis_numba.simulation.mirrors import Seen, images
from ertis_numba.simulation.snapshot import ReceiverPose, Snapshot, TransmitterPose

__all__ = ["walls"]


def walls(
    shot: Snapshot, transmitter: TransmitterPose
) -> tuple[tuple[Seen[TransmitterPose], ...], tuple[Seen[ReceiverPose], ...], tuple[Seen[TransmitterPose], ...]]:
    """Return an emitter as the targets see it, the microphones as they do, and the emitter as the microphones do.

    The first of each list is the thing itself, the others are its images, of up to the scene's
    ``max_reflections`` walls, as far as they can be seen.
    """
    largest = shot.scene.max_reflections
    receiver_m = shot.receiver.centre_m[None]
    return (
        tuple(images(transmitter, shot.targets.positions_m, shot.mirrors, largest)),
        tuple(images(shot.receiver, shot.targets.positions_m, shot.mirrors, largest)),
        tuple(images(transmitter, receiver_m, shot.mirrors, largest)),
    )
