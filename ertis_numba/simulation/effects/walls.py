"""Mirror images of emitters and targets in walls."""

from typing import Final

import numpy as np

from ertis_numba.simulation.effects._effect import Effect
from ertis_numba.simulation.estimates import Estimate, ghosts
from ertis_numba.simulation.mirrors import Seen, images
from ertis_numba.simulation.sight import Sight
from ertis_numba.simulation.snapshot import ReceiverPose, Snapshot, TransmitterPose

__all__ = ["EFFECT", "walls"]


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


def _estimate(sight: Sight) -> Estimate | None:
    """Find the strongest echo over a wall."""
    if not sight.shot.mirrors:
        return None
    more = sight.echoes(sight.active | {"walls"})
    new = np.array([name not in sight.heard.names for name in more.names], dtype=np.bool_)
    return ghosts(sight, more, new, "{name} appears at {range:.2f} m, {level:+.1f} dB relative to the image there")


EFFECT: Final = Effect(
    name="walls",
    about="mirror images of emitters and targets in walls",
    equation="image p − 2 ((p − q)·n) n, kept if all mirror points lie on their walls",
    source="Allen and Berkley, 1979; Borish, 1984",
    needed_if="an image or a mirror echo arrives in the window",
    changes_paths=True,
    estimate=_estimate,
)
