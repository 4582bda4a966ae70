"""Kernels of occupancy maps in plain NumPy: reference for the compiled ones, and their substitute without a compiler.

They compute in the type of ``out``, so that float64 arrays give an exact reference.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.arrays import Real
from ertis_numba.kernels._contract.mapping import Counts, Doubles, MappingKernels

__all__ = ["KERNELS"]


def find_walls(
    log_odds: Real, place: Doubles, direction: Doubles, step: float, wall: np.float32, n_steps: int, out: Counts
) -> None:
    """Find the first occupied cell in each direction."""
    way = (np.arange(n_steps) + 0.5) * step
    layer, row, column = (
        np.rint(place[axis] + direction[:, axis, None] * way).astype(np.int64).clip(0, size - 1)
        for axis, size in zip((2, 1, 0), log_odds.shape, strict=True)
    )
    is_wall = log_odds[layer, row, column] > wall
    out[:] = np.where(is_wall.any(axis=1), is_wall.argmax(axis=1), n_steps)


def spread_echoes(place: Doubles, precision: Doubles, reach: Doubles, peak: Doubles, most: Doubles, out: Real) -> None:
    """Add the density of normally distributed echoes to the cells around them."""
    for centre, inverse, far, density, limit in zip(place, precision, reach, peak, most, strict=True):
        x, y, z = (
            np.arange(max(0, math.ceil(middle - within)), min(size, math.floor(middle + within) + 1))
            for middle, within, size in zip(centre, far, out.shape[::-1], strict=True)
        )
        if not (len(x) and len(y) and len(z)):
            continue
        cells = np.ix_(z, y, x)
        offset = np.stack(np.broadcast_arrays(*(np.ix_(z - centre[2], y - centre[1], x - centre[0])[::-1])), axis=-1)
        squared = np.einsum("lrci,ij,lrcj->lrc", offset, inverse, offset)
        out[cells] += np.minimum(density * np.exp(-squared / 2), limit).astype(out.dtype)


def add_evidence(
    occupied: Real,
    touched: np.float32,
    most: np.float32,
    free: Real,
    place: Doubles,
    rotation: Doubles,
    step: float,
    near: float,
    near_free: np.float32,
    limit: np.float32,
    out: Real,
) -> None:
    """Add the evidence of one pulse to a map."""
    evidence = np.minimum(occupied, most)
    z, y, x = np.ix_(*(np.arange(size) - place[axis] for axis, size in zip((2, 1, 0), out.shape, strict=True)))
    local = np.stack(np.broadcast_arrays(x, y, z), axis=-1) @ rotation
    away = np.linalg.norm(local, axis=-1)
    shown = np.where(away < near, near_free, _at(free, local, away / step))
    shown = np.where(shown < 0, np.minimum(-shown, np.maximum(out, 0)), shown)
    shown[occupied > touched] = 0
    out[:] = np.where(evidence - shown != 0, (out + evidence - shown).clip(-limit, limit), out)


def _at(free: Real, local: Doubles, step: Doubles) -> NDArray[np.float32]:
    """Return the evidence for free cells at places in the frame of the polar grid."""
    n_elevations, n_azimuths, n_steps = free.shape
    azimuth = ((np.arctan2(local[..., 1], local[..., 0]) / (2 * math.pi) + 0.5) * n_azimuths).astype(int) % n_azimuths
    turn = np.arctan2(local[..., 2], np.hypot(local[..., 0], local[..., 1])) / math.pi + 0.5
    elevation = np.minimum((turn * n_elevations).astype(int), n_elevations - 1)
    found = free[elevation, azimuth, np.minimum(step, n_steps - 1).astype(int)]
    return np.where(step < n_steps, found, np.float32(0))


KERNELS = MappingKernels(find_walls=find_walls, spread_echoes=spread_echoes, add_evidence=add_evidence)
