"""Range zones: spherical wavefronts by delays that hold for a stretch of ranges."""

import itertools

import numpy as np
from numpy.typing import NDArray

__all__ = ["NEAREST_M", "squared_curvature", "zone_edges"]

NEAREST_M = 1e-3
"""What stands for range 0, where a wavefront has no curvature to speak of."""

_MIN_M = 1e-9  # a distance, so that it can be divided by


def zone_edges(range_m: NDArray[np.float64], count: int) -> list[tuple[int, int, float]]:
    """Return zones over which the curvature changes by the same amount.

    The delay of a microphone at p differs from that of a plane wave by ``p²/2rc`` in the main, so it is steps of
    1/r, not of r, that make every zone err alike. The delays of a zone are those of its middle curvature.

    Parameters
    ----------
    range_m : (range,) float64
        Ascending.
    count : int
        Steps of the curvature between the ends. Those that hold no range make no zone.

    Returns
    -------
    list of (first, stop, distance)
        Ranges ``first … stop - 1`` of each zone and the distance in metres whose delays it has.
    """
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
    """Return by how much curvatures differ from those of their zones: the mean square over ranges, in 1/m²."""
    middle = np.concatenate(
        [np.full(stop - first, 1 / max(distance_m, NEAREST_M)) for first, stop, distance_m in edges]
    )
    return float(np.mean((1 / np.maximum(range_m, NEAREST_M) - middle) ** 2))
