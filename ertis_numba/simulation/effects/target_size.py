"""Spheres have a surface, discs face somewhere."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.effects.piston import piston
from ertis_numba.simulation.mirrors import Seen
from ertis_numba.simulation.paths import Paths, turning, unit
from ertis_numba.simulation.snapshot import Ear, Mouth, Targets

__all__ = ["disc_pattern", "over_surfaces"]


def over_surfaces(first: Seen[Mouth], second: Seen[Ear], targets: Targets, chosen: NDArray[np.intp]) -> Paths:
    """Return paths that turn on the surface of spheres rather than in their centre.

    The arguments are those of `by_targets`.

    The mirror point lies where the surface's normal halves the angle between the legs; the directions from
    the centre to both ends stand for those from the surface, which is exact for equal distances and
    else wrong by the third power of radius by distance.
    """
    centre_m = targets.positions_m[chosen, None, :]
    outwards = unit(unit(first.end.position_m - centre_m) + unit(second.end.positions_m - centre_m))
    turns_m = centre_m + targets.radius_m[chosen, None, None] * outwards
    return turning(first, second, targets, chosen, turns_m, surface=True)


def disc_pattern(paths: Paths, frequency_hz: NDArray[np.float64], speed_m_s: float) -> NDArray[np.float64]:
    """Return what discs send towards the ear of what reaches them: (path, 1, frequency) float64.

    The far field of a plane circular mirror, ``2 J₁(v) / v`` with ``v = π d f |s| / c``, s being the sum of the
    unit vectors towards both ends without its part along the normal (Kirchhoff's approximation without its
    obliquity; both
    ends on the facing side, else nothing).
    """
    towards_ear = unit(np.mean(paths.arriving, axis=1))
    towards_mouth = unit(-np.mean(paths.leaving, axis=1))
    normal = paths.targets.normals
    both = towards_ear + towards_mouth
    aside = np.linalg.norm(both - np.sum(both * normal, axis=-1, keepdims=True) * normal, axis=-1)
    pattern = piston(math.pi / speed_m_s * (paths.targets.diameter_m * aside)[:, None] * frequency_hz)
    seen = (np.sum(towards_ear * normal, axis=-1) > 0) & (np.sum(towards_mouth * normal, axis=-1) > 0)
    is_disc = paths.targets.diameter_m > 0
    return np.asarray(np.where((is_disc & ~seen)[:, None], 0.0, pattern)[:, None, :])
