"""Shapes of wavefronts across an array, and the axes along which its microphones differ."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["curved_m", "places_of"]

_DEGENERATE_M: Final = 1e-3


def places_of(positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions along the axes in which the array extends: (mic, used axis) float64."""
    _, extent, axes = np.linalg.svd(positions_m - positions_m.mean(axis=0), full_matrices=False)
    return np.asarray(positions_m @ axes[extent / np.sqrt(len(positions_m)) > _DEGENERATE_M].T)


def curved_m(positions_m: NDArray[np.float64], slope_m: NDArray[np.float64], curvature: float) -> NDArray[np.float64]:
    """Return the way of a spherical wave relative to a plane one of the same direction: (..., mic) float64.

    For the distance R of the source in direction u, and p·u = -slope, it is sqrt(R² + 2 R slope + p²) - R - slope.
    """
    radius_m = 1 / curvature
    squared_m2 = np.maximum(0.0, radius_m**2 + 2 * radius_m * slope_m + np.sum(positions_m**2, axis=-1))
    return np.asarray(np.sqrt(squared_m2) - radius_m - slope_m)
