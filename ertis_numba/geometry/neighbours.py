"""Nearest neighbours and spacing of directions, and grouping of directions by azimuth."""

import math
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry.delays import unit_vectors

__all__ = ["AzimuthColumns", "Nearest", "azimuth_columns", "spacing_rad"]

Level = TypeVar("Level", bound=np.generic)

_NEAREST_RAD = 1e-9  # directions closer than this are the same
_SAME_DIGITS = 9  # decimals in which the unit vectors of equal directions agree
_FINER = 4  # columns of a raster per spacing: a direction is displaced by at most an eighth of a spacing
_FEW: Final = 4000
_BLOCK: Final = 16  # places; so few that BLAS uses one thread, since others spin


class Nearest:
    """Search for the nearest of some points (point, axis), with SciPy's trees only if there are many."""

    # Importing SciPy's trees takes 0.15 s and 30 MB.

    def __init__(self, points: NDArray[np.float64]) -> None:
        self._points, self._tree = points, None
        if len(points) > _FEW:
            from scipy.spatial import KDTree  # noqa: PLC0415

            self._tree = KDTree(points)
        self._columns = np.concatenate([-2 * points, np.sum(points**2, axis=1, keepdims=True)], axis=1).T

    def query(self, places: NDArray[np.float64], k: int = 1) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Return distances and indices of the ``k`` nearest points, (place, k) or for one (place,), as a tree does."""
        if self._tree is not None:
            found: Any = self._tree.query(places, k)
            return found[0], found[1]
        nearest = np.empty((len(places), k), np.intp)
        rows = np.concatenate([places, np.ones((len(places), 1))], axis=1)
        for start in range(0, len(places), _BLOCK):
            apart = rows[start : start + _BLOCK] @ self._columns  # squared, except for a constant
            if k == 1:
                nearest[start : start + _BLOCK, 0] = apart.argmin(axis=1)
            else:
                nearest[start : start + _BLOCK] = np.argpartition(apart, k - 1, axis=1)[:, :k]
        distance = np.linalg.norm(self._points[nearest] - places[:, None], axis=2)
        order = np.argsort(distance, axis=1, kind="stable")
        nearest, distance = np.take_along_axis(nearest, order, 1), np.take_along_axis(distance, order, 1)
        return (distance[:, 0], nearest[:, 0]) if k == 1 else (distance, nearest)


def spacing_rad(directions: NDArray[np.float64]) -> float:
    """Return the median angle from a unit vector (direction, axis) to its nearest different neighbour; π for none."""
    if len(directions) < 2:
        return math.pi
    distance, _ = Nearest(directions).query(directions, k=2)
    if distance[:, 1].min() < _NEAREST_RAD:  # Directions that are listed twice, such as -180° and 180°, count once.
        rounded = np.unique(np.round(directions, _SAME_DIGITS) + 0.0, axis=0)  # Adding 0 turns -0 into 0.
        if len(rounded) < 2:
            return math.pi
        distance, _ = Nearest(rounded).query(rounded, k=2)
    return 2 * math.asin(min(1.0, float(np.median(distance[:, 1])) / 2))


@dataclass(frozen=True, slots=True)
class AzimuthColumns:
    """Azimuths (column,) in increasing order, and the directions near each of them."""

    azimuth_rad: NDArray[np.float64]
    _order: NDArray[np.intp]
    _edges: NDArray[np.intp]

    def strongest(self, levels: NDArray[Level]) -> NDArray[Level]:
        """Return the maximum of levels (direction, ...) near each azimuth: (column, ...)."""
        ordered = levels[np.append(self._order, self._order[-1])]  # one more, because the last column may end there
        return np.asarray(np.maximum.reduceat(ordered, self._edges, axis=0)[::2])


def azimuth_columns(azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64]) -> AzimuthColumns:
    """Return columns of azimuths for display, each with the directions within half of their spacing."""
    order = np.argsort(azimuth_rad, kind="stable")
    rising = azimuth_rad[order]
    columns = rising[np.diff(rising, prepend=-np.inf) > _NEAREST_RAD]
    half_rad = _NEAREST_RAD
    if len(columns) > 1 and np.any(elevation_rad):
        half_rad = max(spacing_rad(unit_vectors(azimuth_rad, elevation_rad)) / 2, _NEAREST_RAD)
        count = math.ceil(float(columns[-1] - columns[0]) / half_rad * _FINER / 2) + 1
        if count < len(columns):
            columns = np.linspace(columns[0], columns[-1], count)
    first, stop = np.searchsorted(rising, columns - half_rad), np.searchsorted(rising, columns + half_rad, side="right")
    some = stop > first
    return AzimuthColumns(columns[some], order, np.stack([first[some], stop[some]], axis=1).ravel())
