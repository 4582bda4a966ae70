"""Walls stand between."""

from ertis_numba.simulation.mirrors import End, Seen, blocked
from ertis_numba.simulation.snapshot import Mirror

__all__ = ["occlusion"]


def occlusion(seen: tuple[Seen[End], ...], mirrors: tuple[Mirror, ...]) -> tuple[Seen[End], ...]:
    """Take away the ways on which a wall stands: no sound goes through it or around its edge."""
    return tuple(Seen(way.end, way.exists & ~blocked(way, mirrors), way.corners_m, way.mirrors) for way in seen)
