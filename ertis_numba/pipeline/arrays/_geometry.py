"""Checks of positions, directions, ranges and array weights."""

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.pipeline.arrays._device import numbers_of
from ertis_numba.settings import MAX_SPAN_M

__all__ = ["directions_of", "places_of", "ranges_of", "weights_of"]

_MAX_STEP_ERROR: Final = 1e-6  # relative to the spacing of ranges


def directions_of(directions_rad: ArrayLike) -> NDArray[np.float64]:
    given = np.asarray(directions_rad)
    if given.ndim != 2 or given.shape[1] != 2 or not len(given) or given.dtype.kind not in "fiu":
        raise ArgumentError(
            f"directions_rad holds {given.dtype} of shape {given.shape}; use azimuth and elevation in radians, of "
            "shape (direction, 2)"
        )
    angles_rad = numbers_of("directions_rad", given, given.shape)
    for axis, limit_rad in ((0, 2 * math.pi), (1, math.pi / 2)):
        wrong = np.flatnonzero(np.abs(angles_rad[:, axis]) > limit_rad * (1 + 1e-12))
        if wrong.size:
            raise ArgumentError(
                f"directions_rad[{wrong[0]}, {axis}] is {angles_rad[wrong[0], axis]:g}; use radians from "
                f"{-limit_rad:.3g} to {limit_rad:.3g}, such as numpy.radians returns"
            )
    return angles_rad


def places_of(positions_m: ArrayLike, n_mics: int, farthest_m: float) -> NDArray[np.float64]:
    """Return microphone positions (mic, 3) of an array that is not too large; images end at farthest_m."""
    places_m = numbers_of("positions_m", positions_m, (n_mics, 3))
    span_m = float(np.ptp(places_m, axis=0).max())
    if span_m > MAX_SPAN_M:
        raise ArgumentError(
            f"positions_m spans {span_m:.4g} m, more than {MAX_SPAN_M:g} m; if the numbers are millimetres, divide "
            "them by 1000"
        )
    largest_m = float(np.linalg.norm(places_m, axis=1).max())
    if largest_m > farthest_m:
        raise ArgumentError(
            f"positions_m lie up to {largest_m:.3g} m from the origin, beyond the last of ranges_m, {farthest_m:.3g} "
            "m; if the unit is not the metre, convert it, or use wavefront='spherical'"
        )
    return places_m


def ranges_of(ranges_m: ArrayLike) -> tuple[NDArray[np.float64], float]:
    """Return ranges and their spacing."""
    given = np.asarray(ranges_m)
    if given.ndim != 1 or not len(given) or given.dtype.kind not in "fiu":
        raise ArgumentError(
            f"ranges_m holds {given.dtype} of shape {given.shape}; use metres of shape (range,), such as "
            "numpy.arange(0.5, 5, 0.004)"
        )
    range_m = numbers_of("ranges_m", given, given.shape)
    if range_m[0] < 0:
        raise ArgumentError(f"ranges_m begins at {range_m[0]:g} m; use ranges of 0 or more")
    if len(range_m) == 1:
        return range_m, 1e-3
    steps_m = np.diff(range_m)
    step_m = float(range_m[-1] - range_m[0]) / len(steps_m)
    if step_m <= 0 or np.abs(steps_m - step_m).max() > max(_MAX_STEP_ERROR * step_m, 1e-9 * range_m[-1]):
        raise ArgumentError(
            f"ranges_m has steps from {steps_m.min():g} to {steps_m.max():g} m; use ascending, evenly spaced ranges, "
            "such as numpy.arange(0.5, 5, 0.004)"
        )
    return range_m, step_m


def weights_of(weights: ArrayLike | None, n_mics: int) -> NDArray[np.float64]:
    """Return weights that add up to 1."""
    if weights is None:
        return np.full(n_mics, 1 / n_mics)
    given = numbers_of("weights", weights, (n_mics,))
    if given.min() < 0 or not given.sum() > 0:
        raise ArgumentError(f"weights holds {given.min():g} and adds up to {given.sum():g}; pass weights of 0 or more")
    return np.asarray(given / given.sum())
