"""Mirror images of emitters and targets in walls."""

import numpy as np

from ertis_numba.simulation.estimates import Estimate, ghosts
from ertis_numba.simulation.mirrors import Views, images
from ertis_numba.simulation.sight import Sight
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["estimate", "views"]


def views(shot: Snapshot, number: int, views: Views) -> Views:
    """Return three views: the emitter and the microphones from the targets, and the emitter from the microphones.

    Each tuple starts with the object itself. Its visible mirror images in up to ``max_reflections`` walls follow.
    """
    transmitter, largest = views[0][0].end, shot.scene.max_reflections
    return shot.once(
        ("walls", number, *transmitter.position_m),
        lambda: (
            tuple(images(transmitter, shot.targets.positions_m, shot.mirrors, largest)),
            tuple(images(shot.receiver, shot.targets.positions_m, shot.mirrors, largest)),
            tuple(images(transmitter, shot.receiver.centre_m[None], shot.mirrors, largest)),
        ),
    )


def estimate(sight: Sight) -> Estimate | None:
    """Find the strongest echo over a wall."""
    if not sight.shot.mirrors:
        return None
    more = sight.echoes(sight.active | {"walls"})
    new = np.array([name not in sight.heard.names for name in more.names], dtype=np.bool_)
    return ghosts(sight, more, new, "{name} appears at {range:.2f} m, {level:+.1f} dB relative to the image there")
