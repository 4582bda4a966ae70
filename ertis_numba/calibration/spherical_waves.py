"""Spherical waves at an array: path lengths from five parameters, and their robust fit to times of arrival."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["N_PARAMETERS", "fit_wave", "wave_lags", "wave_slopes"]

N_PARAMETERS: Final = 5
"""Path length, direction x, y and z, and curvature."""
_DAMPING: Final = 1e-9
_MAX_SHRINK: Final = 1e-4  # Smallest square root that the near field may yield; a source within the array has none.


def wave_lags(
    direction: NDArray[np.float64], curvature_1_m: NDArray[np.float64], positions_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the path to each microphone minus that to the origin: (..., mic), m.

    The source is at distance ``r = 1 / κ`` in the direction u: ``|r u − x| − r = (√(1 − 2 κ u·x + κ² |x|²) − 1) / κ``.
    """
    along_m, root = _root(direction, curvature_1_m, positions_m)
    squared_m2 = np.sum(positions_m**2, axis=1)
    # This form is exact for plane waves, too.
    return np.asarray((np.asarray(curvature_1_m)[..., None] * squared_m2 - 2 * along_m) / (1 + root))


def wave_slopes(
    direction: NDArray[np.float64], curvature_1_m: float, positions_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivatives of path lengths by path, direction and curvature: (mic, parameter)."""
    along_m, root = _root(direction, np.float64(curvature_1_m), positions_m)
    squared_m2 = np.sum(positions_m**2, axis=1)
    by_curvature = (squared_m2 - along_m**2) / (root * (root + 1 - curvature_1_m * along_m))
    return np.column_stack([np.ones(len(positions_m)), -positions_m / root[:, None], by_curvature])


def _root(
    direction: NDArray[np.float64], curvature_1_m: NDArray[np.float64] | np.float64, positions_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    along_m = np.asarray(direction) @ positions_m.T
    curvature = np.asarray(curvature_1_m)[..., None]
    squared = 1 - 2 * curvature * along_m + curvature**2 * np.sum(positions_m**2, axis=1)
    return along_m, np.sqrt(np.maximum(squared, _MAX_SHRINK))


def fit_wave(
    paths_m: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    start: NDArray[np.float64],
    scale_m: float,
    *,
    n_rounds: int = 6,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a spherical wave to path lengths (mic,) by Gauss-Newton; return it, and weights (mic,) from 0 to 1."""
    wave = np.array(start, dtype=np.float64)
    weight = np.ones(len(paths_m))
    for _ in range(n_rounds):
        rest_m = paths_m - wave[0] - wave_lags(wave[1:4], wave[4], positions_m)
        weight = 1 / (1 + (rest_m / scale_m) ** 2)
        slopes = wave_slopes(wave[1:4], float(wave[4]), positions_m)
        normal = (slopes.T * weight) @ slopes
        # A flat array does not observe the direction across it; the damping leaves it unchanged.
        normal += _DAMPING * np.trace(normal) * np.eye(N_PARAMETERS)
        step = np.linalg.solve(normal, (slopes.T * weight) @ rest_m)
        step[1:4] *= min(1.0, 0.2 / max(float(np.linalg.norm(step[1:4])), 1e-12))
        wave = wave + step
    return wave, weight
