"""Mirror images of emitters and targets in walls."""

from ertis_numba.simulation.mirrors import Seen, images
from ertis_numba.simulation.snapshot import ReceiverPose, Snapshot, TransmitterPose

__all__ = ["walls"]


def walls(
    shot: Snapshot, transmitter: TransmitterPose
) -> tuple[tuple[Seen[TransmitterPose], ...], tuple[Seen[ReceiverPose], ...], tuple[Seen[TransmitterPose], ...]]:
    """Return three views: the emitter and the microphones from the targets, and the emitter from the microphones.

    Each tuple starts with the object itself. Its visible mirror images in up to ``max_reflections`` walls follow.
    """
    largest = shot.scene.max_reflections
    receiver_m = shot.receiver.centre_m[None]
    return (
        tuple(images(transmitter, shot.targets.positions_m, shot.mirrors, largest)),
        tuple(images(shot.receiver, shot.targets.positions_m, shot.mirrors, largest)),
        tuple(images(transmitter, receiver_m, shot.mirrors, largest)),
    )
