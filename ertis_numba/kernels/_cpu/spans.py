"""Explicit loops instead of NumPy functions: Numba takes seconds to compile NumPy's minimum."""

import numpy as np
from numba import njit

__all__ = ["clear", "node_span"]


@njit(nogil=True, cache=True)
def node_span(places, begin, end):
    """Return the lowest and the highest beam-grid point that the directions ``begin … end`` use."""
    low, high = np.int64(places[begin, 0]), np.int64(places[begin, 0])
    for direction in range(begin, end):
        for pair in range(places.shape[1]):
            place = np.int64(places[direction, pair])
            low, high = min(low, place), max(high, place)
    return low, high + 1


@njit(nogil=True, cache=True)
def clear(rows, begin, end):
    """Set the columns ``begin … end`` of all rows to 0."""
    for row in range(rows.shape[0]):
        for k in range(begin, end):
            rows[row, k] = 0
