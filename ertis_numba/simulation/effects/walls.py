"""Mirror images of emitters and targets in walls."""

import numpy as np

from ertis_numba.simulation.estimates import Estimate, ghosts
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.mirrors import Views, images
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["estimate", "views"]


def views(shot: Snapshot, number: int, views: Views) -> Views:
    """Return views over up to ``max_reflections`` walls: from the targets to both ends, and between the ends."""
    transmitter, largest = views[0].ends, shot.scene.max_reflections
    return shot.once(
        ("walls", number, *transmitter.position_m[0]),
        lambda: (
            images(transmitter, shot.targets.positions_m, shot.mirrors, largest),
            images(shot.receiver, shot.targets.positions_m, shot.mirrors, largest),
            images(transmitter, shot.receiver.centre_m, shot.mirrors, largest),
        ),
    )


def estimate(sight: Sight) -> Estimate | None:
    """Find the strongest echo over a wall."""
    if not sight.shot.mirrors:
        return None
    more = sight.echoes(sight.active | {"walls"})
    heard = set(sight.heard.names)
    new = np.array([name not in heard for name in more.names], dtype=np.bool_)
    return ghosts(sight, more, new, "{name} appears at {range:.2f} m, {level:+.1f} dB relative to the image there")
