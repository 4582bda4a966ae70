"""Focal zones: parts of the range axis that share one set of delays, for spherical wavefronts."""

import itertools

import numpy as np
from numpy.typing import NDArray

__all__ = ["NEAREST_M", "squared_curvature", "zone_edges"]

NEAREST_M = 1e-3
"""Distance in metres that replaces range 0, where the curvature of a wavefront is undefined."""

_MIN_M = 1e-9  # Minimum distance; it prevents a division by zero.


def zone_edges(range_m: NDArray[np.float64], count: int) -> list[tuple[int, int, float]]:
    """Return focal zones (first, stop, distance in m of their mean curvature) in ``count`` equal steps of 1/r."""
    # Equal steps of 1/r give every zone the same error, because extra delays are about `p²/2rc`.
    bends = 1 / np.maximum(range_m, NEAREST_M)
    span = bends[0] - bends[-1]
    zone = np.zeros(len(bends), dtype=int) if not span else np.floor((bends[0] - bends) / span * count).astype(int)
    edges = [0, *(np.flatnonzero(np.diff(np.minimum(zone, count - 1))) + 1).tolist(), len(bends)]
    found = []
    for first, stop in itertools.pairwise(edges):
        distance_m = float(2 / (bends[first] + bends[stop - 1])) if stop - first > 1 else float(range_m[first])
        found.append((first, stop, max(distance_m, _MIN_M)))
    return found


def squared_curvature(range_m: NDArray[np.float64], edges: list[tuple[int, int, float]]) -> float:
    """Return the mean squared deviation of the curvature from that of its focal zone, over all ranges, in 1/m²."""
    middle = np.concatenate(
        [np.full(stop - first, 1 / max(distance_m, NEAREST_M)) for first, stop, distance_m in edges]
    )
    return float(np.mean((1 / np.maximum(range_m, NEAREST_M) - middle) ** 2))
