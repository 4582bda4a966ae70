"""Shapes of wavefronts across an array, and the axes along which its microphones differ."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["CURVATURES", "curved_m", "fit_curved", "places_of"]

CURVATURES: Final = (1.0, 2.0)
"""Curvatures of the echoes of a wall and of a point at the same path, times the path."""
_DEGENERATE_M: Final = 1e-3
_ITERATIONS: Final = 6


def places_of(positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions along the axes in which the array extends: (mic, used axis) float64."""
    _, extent, axes = np.linalg.svd(positions_m - positions_m.mean(axis=0), full_matrices=False)
    return np.asarray(positions_m @ axes[extent / np.sqrt(len(positions_m)) > _DEGENERATE_M].T)


def curved_m(positions_m: NDArray[np.float64], slope_m: NDArray[np.float64], curvature: float) -> NDArray[np.float64]:
    """Return the way of a spherical wave relative to a plane one of the same direction: (..., mic).

    For the distance R of the source in direction u, and p·u = -slope, it is sqrt(R² + 2 R slope + p²) - R - slope.
    """
    radius_m = 1 / curvature
    squared_m2 = np.maximum(0.0, radius_m**2 + 2 * radius_m * slope_m + np.sum(positions_m**2, axis=-1))
    return np.asarray(np.sqrt(squared_m2) - radius_m - slope_m)


def fit_curved(
    times_s: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    curvature: float,
    speed_m_s: float,
    slopes_of: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Return times of arrival (..., mic) without the delays by the curvature of the wave, in 1/m."""
    places_m, flat_s = places_of(positions_m), times_s
    for _ in range(_ITERATIONS):
        slope_m = slopes_of(flat_s) @ places_m.T * speed_m_s
        flat_s = times_s - curved_m(positions_m, slope_m, curvature) / speed_m_s
    return flat_s
