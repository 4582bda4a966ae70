# mypy: ignore-errors
"""Occupancy maps: walls in each direction, echoes spread over cells, and free cells in front of them."""

import math

import numpy as np
from numba import njit

from ertis_numba.kernels._contract.mapping import MappingKernels

__all__ = ["KERNELS"]

_ZERO = np.float32(0)


@njit(nogil=True, cache=True, error_model="numpy")
def find_walls(log_odds, place, direction, step, wall, n_steps, out):
    """Find the first occupied cell in each direction."""
    n_layers, n_rows, n_columns = log_odds.shape
    for d in range(len(direction)):
        out[d] = n_steps
        for s in range(n_steps):
            way = (s + 0.5) * step
            column = min(max(int(np.rint(place[0] + direction[d, 0] * way)), 0), n_columns - 1)
            row = min(max(int(np.rint(place[1] + direction[d, 1] * way)), 0), n_rows - 1)
            layer = min(max(int(np.rint(place[2] + direction[d, 2] * way)), 0), n_layers - 1)
            if log_odds[layer, row, column] > wall:
                out[d] = s
                break


@njit(nogil=True, cache=True, error_model="numpy")
def spread_echoes(place, precision, reach, peak, most, out):
    """Add the density of normally distributed echoes to the cells around them."""
    for e in range(len(place)):
        first_column, end_column = _within(place[e, 0], reach[e, 0], out.shape[2])
        first_row, end_row = _within(place[e, 1], reach[e, 1], out.shape[1])
        first_layer, end_layer = _within(place[e, 2], reach[e, 2], out.shape[0])
        p = precision[e]
        for layer in range(first_layer, end_layer):
            z = layer - place[e, 2]
            for row in range(first_row, end_row):
                y = row - place[e, 1]
                for column in range(first_column, end_column):
                    x = column - place[e, 0]
                    crossed = p[0, 1] * x * y + p[0, 2] * x * z + p[1, 2] * y * z
                    squared = p[0, 0] * x * x + p[1, 1] * y * y + p[2, 2] * z * z + 2 * crossed
                    out[layer, row, column] += np.float32(min(peak[e] * math.exp(-squared / 2), most[e]))


@njit(nogil=True, cache=True, error_model="numpy")
def _within(place, reach, count):
    """Return the first cell within a distance along an axis, and the one after the last."""
    first, end = math.ceil(place - reach), math.floor(place + reach) + 1
    return min(max(int(first), 0), count), min(max(int(end), 0), count)


@njit(nogil=True, cache=True, error_model="numpy")
def add_evidence(occupied, touched, most, free, place, rotation, step, near, near_free, limit, out):
    """Add the evidence of one pulse to a map."""
    n_layers, n_rows, n_columns = out.shape
    n_steps = free.shape[2]
    n_free, n_used = _farthest(free)
    far_free, far = max(n_free * step, near), max(n_used * step, near)
    r = rotation
    for layer in range(n_layers):
        z = layer - place[2]
        for row in range(n_rows):
            y = row - place[1]
            for column in range(n_columns):
                evidence = min(occupied[layer, row, column], most)
                x = column - place[0]
                away = math.sqrt(x * x + y * y + z * z)
                # Beyond the free ranges, only occupied cells can lose evidence.
                if evidence <= touched and away < (far if out[layer, row, column] > _ZERO else far_free):
                    if away < near:
                        evidence -= near_free
                    else:
                        # The transpose of a rotation is its inverse.
                        ahead = r[0, 0] * x + r[1, 0] * y + r[2, 0] * z
                        left = r[0, 1] * x + r[1, 1] * y + r[2, 1] * z
                        up = r[0, 2] * x + r[1, 2] * y + r[2, 2] * z
                        s = int(away / step)
                        if s < n_steps:
                            shown = free[
                                _elevation(ahead, left, up, free.shape[0]), _azimuth(ahead, left, free.shape[1]), s
                            ]
                            if shown < _ZERO:
                                shown = min(-shown, max(out[layer, row, column], _ZERO))
                            evidence -= shown
                if evidence != _ZERO:
                    out[layer, row, column] = min(max(out[layer, row, column] + evidence, -limit), limit)


@njit(nogil=True, cache=True, error_model="numpy")
def _farthest(free):
    """Return the number of ranges up to the last free one, and up to the last one with evidence."""
    n_free = n_used = 0
    for elevation in range(free.shape[0]):
        for azimuth in range(free.shape[1]):
            for s in range(free.shape[2] - 1, n_free - 1, -1):
                if free[elevation, azimuth, s] != _ZERO:
                    n_used = max(n_used, s + 1)
                if free[elevation, azimuth, s] > _ZERO:
                    n_free = s + 1
                    break
    return n_free, n_used


@njit(nogil=True, cache=True, error_model="numpy")
def _azimuth(ahead, left, n_azimuths):
    return int((math.atan2(left, ahead) / (2 * math.pi) + 0.5) * n_azimuths) % n_azimuths


@njit(nogil=True, cache=True, error_model="numpy")
def _elevation(ahead, left, up, n_elevations):
    if n_elevations == 1:
        return 0
    row = int((math.atan2(up, math.sqrt(ahead * ahead + left * left)) / math.pi + 0.5) * n_elevations)
    return min(row, n_elevations - 1)


KERNELS = MappingKernels(find_walls=find_walls, spread_echoes=spread_echoes, add_evidence=add_evidence)
