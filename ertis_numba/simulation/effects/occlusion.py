"""Walls that block sound paths."""

import math

import numpy as np

from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.mirrors import End, Seen, Views, blocked
from ertis_numba.simulation.snapshot import Mirrors, Snapshot
from ertis_numba.simulation.surroundings import greatest

__all__ = ["estimate", "views"]


def views(shot: Snapshot, number: int, views: Views) -> Views:
    """Remove the paths that a wall blocks; transmission and diffraction are not modelled."""
    firsts, seconds, specular = views
    return _open(firsts, shot.mirrors), _open(seconds, shot.mirrors), _open(specular, shot.mirrors)


def _open(seen: Seen[End], mirrors: Mirrors) -> Seen[End]:
    return seen.chosen(~blocked(seen, mirrors))


def estimate(sight: Sight) -> Estimate | None:
    """Find the strongest echo that a wall blocks."""
    if not sight.shot.mirrors:
        return None
    left = sight.echoes(sight.active | {"occlusion"})
    still = set(left.names)
    hidden = np.array([name not in still for name in sight.heard.names], dtype=np.bool_)
    if not hidden.any():
        return Estimate(change_db=0.0, reason="no wall blocks any path")
    delay_s = sight.heard.delay_s
    level = hidden * sight.heard.level * sight.reach(delay_s)
    worst = int(np.argmax(level))
    around = Sight.of(sight.shot, sight.active | {"occlusion"}).surroundings()
    _, ratio = greatest(level / around.floor, lambda part: level[part] / around.at(delay_s[part]))
    return Estimate(
        change_db=20 * math.log10(1 + ratio),
        reason=f"a wall blocks {sight.heard.names[worst]}"
        + (f" and {int(hidden.sum()) - 1} more" if hidden.sum() > 1 else ""),
    )
