"""Walls that block sound paths."""

import numpy as np

from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.mirrors import End, Seen, Views, blocked
from ertis_numba.simulation.sight import Sight, change_db
from ertis_numba.simulation.snapshot import Mirror, Snapshot

__all__ = ["estimate", "views"]


def views(shot: Snapshot, number: int, views: Views) -> Views:
    """Remove the paths that a wall blocks; transmission and diffraction are not modelled."""
    firsts, seconds, specular = views
    return _open(firsts, shot.mirrors), _open(seconds, shot.mirrors), _open(specular, shot.mirrors)


def _open(seen: tuple[Seen[End], ...], mirrors: tuple[Mirror, ...]) -> tuple[Seen[End], ...]:
    return tuple(Seen(way.end, way.exists & ~blocked(way, mirrors), way.corners_m, way.mirrors) for way in seen)


def estimate(sight: Sight) -> Estimate | None:
    """Find the strongest echo that a wall blocks."""
    if not sight.shot.mirrors:
        return None
    left = sight.echoes(sight.active | {"occlusion"})
    hidden = np.array([name not in left.names for name in sight.heard.names], dtype=np.bool_)
    if not hidden.any():
        return Estimate(change_db=0.0, reason="no wall blocks any path")
    level = hidden * sight.levels(sight.heard) * sight.reach(sight.heard.delay_s)
    worst = int(np.argmax(level))
    open_sight = Sight.of(sight.shot, sight.active | {"occlusion"})
    beside = open_sight.beside(sight.heard.delay_s)
    return Estimate(
        change_db=change_db(level, beside),
        reason=f"a wall blocks {sight.heard.names[worst]}"
        + (f" and {int(hidden.sum()) - 1} more" if hidden.sum() > 1 else ""),
    )
