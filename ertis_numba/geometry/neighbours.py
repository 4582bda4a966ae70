"""How far directions lie apart, and which of them share an azimuth."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry.delays import unit_vectors

__all__ = ["AzimuthColumns", "azimuth_columns", "spacing_rad"]

_NEAREST_RAD = 1e-9  # directions that are the same have no spacing


def spacing_rad(directions: NDArray[np.float64]) -> float:
    """Return the usual angle from a direction to its nearest neighbour, half a turn where there is none.

    Parameters
    ----------
    directions : (direction, axis) float64
        Unit vectors.
    """
    # SciPy's trees take a tenth of a second to import, and a processed measurement needs none.
    from scipy.spatial import KDTree  # noqa: PLC0415

    if len(directions) < 2:
        return math.pi
    distance, _ = KDTree(directions).query(directions, k=2)
    return 2 * math.asin(min(1.0, float(np.median(distance[:, 1])) / 2))


class AzimuthColumns(NamedTuple):
    """Directions by their azimuth: ``np.maximum.reduceat(levels[order], starts)`` is the strongest of each.

    Attributes
    ----------
    azimuth_rad : (column,) float64
        Rising.
    order : (direction,) intp
    starts : (column,) intp
        Where in the order the directions of each azimuth begin.
    """

    azimuth_rad: NDArray[np.float64]
    order: NDArray[np.intp]
    starts: NDArray[np.intp]


def azimuth_columns(azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64]) -> AzimuthColumns:
    """Gather directions of about the same azimuth; in a plane each is one by itself.

    Parameters
    ----------
    azimuth_rad, elevation_rad : (direction,) float64
    """
    if len(azimuth_rad) == 1 or not np.any(elevation_rad):
        order = np.argsort(azimuth_rad, kind="stable")
        return AzimuthColumns(azimuth_rad[order], order, np.arange(len(order)))
    step_rad = max(spacing_rad(unit_vectors(azimuth_rad, elevation_rad)), _NEAREST_RAD)
    bins = np.rint((azimuth_rad - azimuth_rad.min()) / step_rad).astype(np.intp)
    order = np.argsort(bins, kind="stable")
    filled, starts = np.unique(bins[order], return_index=True)
    return AzimuthColumns(azimuth_rad.min() + filled * step_rad, order, starts)
