"""From directions and ranges to the pixels of a raster."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ertis_numba.frames import Energyscape
from ertis_numba.geometry import unit_vectors

__all__ = [
    "PIXELS",
    "flattened",
    "join_ranges",
    "maximum_over_elevation",
    "polar_raster",
    "spacing_rad",
    "sphere_raster",
    "volume_raster",
]

PIXELS = 1000  # along the longer side of a raster
_RADIAL_BINS = 500
_NEAREST = 4  # directions that a place between them is interpolated from
_FAR = 1.3  # spacings from the nearest direction, beyond which nothing is known


def join_ranges(
    range_m: NDArray[np.float64], level_db: NDArray[np.float32], *, most: int = _RADIAL_BINS
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Join ranges finer than a pixel to their maximum, so that no reflector falls between pixels."""
    step = -(-len(range_m) // most)
    if step == 1:
        return range_m, level_db
    starts = np.arange(0, len(range_m), step)
    ends = np.minimum(starts + step, len(range_m)) - 1
    return (range_m[starts] + range_m[ends]) / 2, np.maximum.reduceat(level_db, starts, axis=1)


def polar_raster(
    level_db: NDArray[np.float32],
    azimuth_rad: NDArray[np.float64],
    range_m: NDArray[np.float64],
    *,
    left_m: NDArray[np.float64],
    ahead_m: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return levels at points of the horizontal plane: (row, column), NaN outside of the image.

    Bilinear between directions and ranges.

    Parameters
    ----------
    level_db : (direction, range) float32
    azimuth_rad : (direction,) float64
        Rising.
    range_m : (range,) float64
        Rising.
    left_m : (column,) float64
    ahead_m : (row,) float64
    """
    radius_m = np.hypot(left_m, ahead_m[:, None])
    direction = np.interp(
        np.arctan2(left_m, ahead_m[:, None]), azimuth_rad, np.arange(len(azimuth_rad)), left=np.nan, right=np.nan
    )
    column = np.interp(radius_m, range_m, np.arange(len(range_m)), left=np.nan, right=np.nan)
    inside = np.isfinite(direction) & np.isfinite(column)
    raster = np.full(radius_m.shape, np.nan, dtype=np.float32)
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
    """Return levels over azimuth and elevation: (row, column), NaN where no direction is near.

    The four nearest directions, weighted by their inverse square distance: they may lie anyhow.

    Parameters
    ----------
    level_db : (direction,) float32
    directions : (direction, axis) float64
        Unit vectors.
    azimuth_rad : (column,) float64
    elevation_rad : (row,) float64
    """
    looks = unit_vectors(*(grid.ravel() for grid in np.meshgrid(azimuth_rad, elevation_rad)))
    place, weight = _around(directions, looks)
    levels = np.sum(weight * level_db[place], axis=1)
    return np.asarray(levels, dtype=np.float32).reshape(len(elevation_rad), len(azimuth_rad))


def volume_raster(
    level_db: NDArray[np.float32],
    directions: NDArray[np.float64],
    range_m: NDArray[np.float64],
    *,
    points_m: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return levels at points of space: (row, column), NaN outside of the image.

    Linear between ranges, else as `sphere_raster`.

    Parameters
    ----------
    level_db : (direction, range) float32
    directions : (direction, axis) float64
        Unit vectors.
    range_m : (range,) float64
        Rising.
    points_m : (row, column, axis) float64
    """
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
    """Return the nearest directions of each look and their weights, NaN where none is near: both (look, nearest)."""
    nearest = min(_NEAREST, len(directions))
    distance, place = cKDTree(directions).query(looks, k=nearest)
    distance = distance.reshape(-1, nearest)
    weight = 1 / np.maximum(distance, 1e-6) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    if len(directions) > 1:
        weight[distance[:, 0] > _FAR * spacing_rad(directions)] = np.nan
    return place.reshape(-1, nearest), weight.astype(np.float32)


def spacing_rad(directions: NDArray[np.float64]) -> float:
    """Return the usual distance from a direction to its nearest neighbour."""
    distance, _ = cKDTree(directions).query(directions, k=2)
    return 2 * math.asin(min(1.0, float(np.median(distance[:, 1])) / 2))


def maximum_over_elevation(
    level_db: NDArray[np.float32], azimuth_rad: NDArray[np.float64], *, spacing_rad: float
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Gather directions of about the same azimuth; return the azimuths and their maxima.

    Parameters
    ----------
    level_db : (direction, range) float32
    azimuth_rad : (direction,) float64
    spacing_rad : float
        Between the azimuths to return, where there are directions.
    """
    first = azimuth_rad.min()
    bins = np.rint((azimuth_rad - first) / max(spacing_rad, 1e-9)).astype(np.intp)
    order = np.argsort(bins, kind="stable")
    filled, starts = np.unique(bins[order], return_index=True)
    return first + filled * spacing_rad, np.maximum.reduceat(level_db[order], starts, axis=0)


def flattened(image: Energyscape, level_db: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return azimuths and their levels, (direction, range): the strongest where there are several elevations."""
    if image.is_planar or len(image.azimuth_rad) == 1:
        return image.azimuth_rad, level_db
    spacing = spacing_rad(unit_vectors(image.azimuth_rad, image.elevation_rad))
    return maximum_over_elevation(level_db, image.azimuth_rad, spacing_rad=spacing)
