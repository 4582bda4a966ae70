"""Resampling from directions and ranges to the pixels of a raster."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ertis_numba.geometry import Fan, reach_rad, spacing_rad, unit_vectors

__all__ = [
    "PIXELS",
    "centres",
    "join_ranges",
    "look_raster",
    "polar_raster",
    "sphere_raster",
    "thickened",
    "volume_raster",
]

PIXELS = 1000  # along the longer side of a raster
_RADIAL_BINS = 500
_NEAREST = 4  # directions that a place between them is interpolated from
_THIN = 0.005  # of the range, to either side: ranges within it would be too thin to be seen


def centres(first: float, last: float, step: float) -> NDArray[np.float64]:
    """Divide an interval into steps of about a given size, and return their centres: (step,) float64."""
    count = max(1, round(abs(last - first) / step))
    return np.asarray(first + (np.arange(count) + 0.5) * (last - first) / count)


def join_ranges(
    range_m: NDArray[np.float64], level_db: NDArray[np.float32], *, largest: int = _RADIAL_BINS
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Join ranges finer than a pixel to their maximum, so that no reflector falls between pixels."""
    step = -(-len(range_m) // largest)
    if step == 1:
        return range_m, level_db
    starts = np.arange(0, len(range_m), step)
    ends = np.minimum(starts + step, len(range_m)) - 1
    return (range_m[starts] + range_m[ends]) / 2, np.maximum.reduceat(level_db, starts, axis=1)


def thickened(
    range_m: NDArray[np.float64], level_db: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return the ranges and levels to draw; a thin image becomes a hundredth of its range thick."""
    first_m, last_m = float(range_m[0]), float(range_m[-1])
    half_m = _THIN * last_m
    if last_m - first_m >= 2 * half_m:
        return range_m, level_db
    middle_m = (first_m + last_m) / 2
    return np.array([middle_m - half_m, middle_m + half_m]), np.repeat(level_db.max(axis=1)[:, None], 2, axis=1)


def polar_raster(
    level_db: NDArray[np.float32],
    fan: Fan,
    range_m: NDArray[np.float64],
    *,
    right_m: NDArray[np.float64],
    ahead_m: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return levels (azimuth, range) at points of the horizontal plane: (row, column), NaN outside of the image."""
    ahead_m = ahead_m[:, None]
    direction, near = fan.directions(right_m, ahead_m)
    places = np.arange(len(range_m))
    column = np.interp(np.hypot(right_m, ahead_m), range_m, places, left=np.nan, right=np.nan)
    inside = near & np.isfinite(column)
    raster = np.full(inside.shape, np.nan, dtype=np.float32)
    raster[inside] = _bilinear(level_db, direction[inside], column[inside])
    return raster


def _bilinear(
    values: NDArray[np.float32], row: NDArray[np.float64], column: NDArray[np.float64]
) -> NDArray[np.float64]:
    above, left = (np.floor(at).astype(np.intp) for at in (row, column))
    below, right = np.minimum(above + 1, values.shape[0] - 1), np.minimum(left + 1, values.shape[1] - 1)
    down, across = row - above, column - left
    first = values[above, left] * (1 - across) + values[above, right] * across
    second = values[below, left] * (1 - across) + values[below, right] * across
    return np.asarray(first * (1 - down) + second * down)


def sphere_raster(
    level_db: NDArray[np.float32],
    directions: NDArray[np.float64],
    *,
    azimuth_rad: NDArray[np.float64],
    elevation_rad: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return levels (direction,) over azimuth and elevation: (row, column), NaN where no direction is near."""
    # It is the mean of the four nearest unit vectors, weighted by inverse square distance.
    looks = unit_vectors(*(grid.ravel() for grid in np.meshgrid(azimuth_rad, elevation_rad)))
    return look_raster(level_db, directions, looks.reshape(len(elevation_rad), len(azimuth_rad), 3))


def look_raster(
    level_db: NDArray[np.float32], directions: NDArray[np.float64], looks: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return levels in the directions of pixels, unit vectors (row, column, axis), as by `sphere_raster`."""
    place, weight = _around(directions, looks.reshape(-1, 3))
    return np.asarray(np.sum(weight * level_db[place], axis=1), np.float32).reshape(looks.shape[:2])


def volume_raster(
    level_db: NDArray[np.float32],
    directions: NDArray[np.float64],
    range_m: NDArray[np.float64],
    *,
    points_m: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return levels (direction, range) at points of space: (row, column), NaN outside of the image."""
    flat_m = points_m.reshape(-1, 3)
    radius_m = np.linalg.norm(flat_m, axis=1)
    column = np.interp(radius_m, range_m, np.arange(len(range_m)), left=np.nan, right=np.nan)
    inside = np.isfinite(column) & (radius_m > 0)
    raster = np.full(len(flat_m), np.nan, dtype=np.float32)
    place, weight = _around(directions, flat_m[inside] / radius_m[inside, None])
    first = np.floor(column[inside]).astype(np.intp)
    after = np.minimum(first + 1, len(range_m) - 1)
    share = (column[inside] - first).astype(np.float32)
    near = np.sum(weight * level_db[place, first[:, None]], axis=1)
    raster[inside] = near * (1 - share) + np.sum(weight * level_db[place, after[:, None]], axis=1) * share
    return raster.reshape(points_m.shape[:2])


def _around(
    directions: NDArray[np.float64], looks: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the nearest directions of each look and their weights, NaN if none is near: both (look, nearest)."""
    nearest = min(_NEAREST, len(directions))
    distance, place = cKDTree(directions).query(looks, k=nearest)
    distance = distance.reshape(-1, nearest)
    weight = 1 / np.maximum(distance, 1e-6) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    gaps_rad = np.full(max(1, len(directions) - 1), spacing_rad(directions))
    weight[distance[:, 0] > reach_rad(gaps_rad)[0]] = np.nan
    return place.reshape(-1, nearest), weight.astype(np.float32)
