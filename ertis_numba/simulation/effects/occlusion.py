"""Walls stand between."""

from collections.abc import Sequence

from ertis_numba.simulation.mirrors import End, Seen, blocked
from ertis_numba.simulation.snapshot import Mirror

__all__ = ["occlusion"]


def occlusion(seen: Sequence[Seen[End]], mirrors: Sequence[Mirror]) -> list[Seen[End]]:
    """Take away the ways on which a wall stands: no sound goes through it or around its edge."""
    return [Seen(way.end, way.exists & ~blocked(way, mirrors), way.corners_m, way.mirrors) for way in seen]
