"""Extent of the directions that are searched, in units of the array's resolution."""

from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

__all__ = ["ScanExtent", "is_level", "scan_extent"]

_GAP: Final = 4.0  # An edge longer than this, relative to the median, spans directions that are not searched.


class ScanExtent(NamedTuple):
    """Sizes of a set of directions, measured by how much the wave of 1 rad/s changes between them.

    The distance of two near directions is the standard deviation over the microphones of the change of their delays.
    At an angular frequency ω, lengths are ω times as long, and areas ω² times as large.

    Attributes
    ----------
    n_parts : float
        Euler characteristic of the set: 1 for a connected set without holes, the number of directions if they are
        separate.
    length_s : float
        Length of directions on a line, or half of the perimeter of an area.
    area_s2 : float
        Area; 0 on a line.
    """

    n_parts: float
    length_s: float
    area_s2: float


def is_level(directions: NDArray[np.float64]) -> bool:
    """Return True if all directions have one elevation.

    Parameters
    ----------
    directions : (direction, axis) float64
        Unit vectors.
    """
    return bool(np.ptp(directions[:, 2]) < 1e-9)


def scan_extent(directions: NDArray[np.float64], delay_s: NDArray[np.float64]) -> ScanExtent:
    """Return the extent of a grid of directions.

    Parameters
    ----------
    directions : (direction, axis) float64
        Unit vectors.
    delay_s : (direction, mic) float64
        Delays of the sound from them.

    Returns
    -------
    ScanExtent
    """
    places = (delay_s - delay_s.mean(axis=1, keepdims=True)) / np.sqrt(delay_s.shape[1])
    if len(directions) < 4:
        return ScanExtent(float(len(directions)), 0.0, 0.0)
    if is_level(directions):
        order = np.argsort(np.arctan2(directions[:, 1], directions[:, 0]))
        steps = np.linalg.norm(np.diff(directions[order], axis=0), axis=1)
        sizes = np.linalg.norm(np.diff(places[order], axis=0), axis=1)
        return ScanExtent(1.0, float(sizes[steps <= _GAP * np.median(steps)].sum()), 0.0)
    return _area(directions, places)


def _area(directions: NDArray[np.float64], places: NDArray[np.float64]) -> ScanExtent:
    """Return the extent of directions on a sphere, from the triangles between them."""
    triangles = scipy.spatial.ConvexHull(directions).simplices
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    long = np.linalg.norm(directions[edges[..., 0]] - directions[edges[..., 1]], axis=2).max(axis=1)
    kept = long <= _GAP * np.median(long)
    first, second = (places[triangles[kept, i]] - places[triangles[kept, 0]] for i in (1, 2))
    squares = (first**2).sum(axis=1) * (second**2).sum(axis=1) - (first * second).sum(axis=1) ** 2
    pairs, counts = np.unique(edges[kept].reshape(-1, 2), axis=0, return_counts=True)
    border = pairs[counts == 1]
    perimeter = np.linalg.norm(places[border[:, 0]] - places[border[:, 1]], axis=1).sum()
    return ScanExtent(1.0, float(perimeter) / 2, float(np.sqrt(np.maximum(squares, 0)).sum()) / 2)
