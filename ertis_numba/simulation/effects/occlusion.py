"""Walls that block sound paths."""

from ertis_numba.simulation.mirrors import End, Seen, blocked
from ertis_numba.simulation.snapshot import Mirror

__all__ = ["occlusion"]


def occlusion(seen: tuple[Seen[End], ...], mirrors: tuple[Mirror, ...]) -> tuple[Seen[End], ...]:
    """Remove the paths that a wall blocks; transmission and diffraction are not modelled."""
    return tuple(Seen(way.end, way.exists & ~blocked(way, mirrors), way.corners_m, way.mirrors) for way in seen)
