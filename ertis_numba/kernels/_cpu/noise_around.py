# mypy: ignore-errors
"""Quantiles of the amplitudes around some bins of an image."""

import numpy as np
from numba import njit

__all__ = ["noise_around"]


@njit(nogil=True, cache=True, error_model="numpy")
def noise_around(amplitude, direction, place, first, n_around, quantiles, fallen, out):
    """Compute the highest quantile of amplitudes in windows around bins."""
    last = amplitude.shape[1] - 1
    around, others = np.empty(n_around, np.float32), np.empty(n_around, np.float32)
    out[:] = 0.0
    for number in range(len(place)):
        row = amplitude[direction[number]]
        for window in range(len(first)):
            for k in range(n_around):
                column = abs(place[number] + first[window] + k)
                around[k] = row[max(last - abs(last - column), 0)]
            begin, end = _slopes(around, min(-first[window], n_around - 1), fallen)
            for q in range(len(quantiles)):
                count = 0
                for k in range(n_around):
                    if not (quantiles[q] > 0.5 and begin <= k < end):
                        others[count] = around[k]
                        count += 1
                if count:
                    out[q, number] = max(out[q, number], _ranked(others, count, int(quantiles[q] * (count - 1))))


@njit(nogil=True, cache=True, error_model="numpy")
def _slopes(around, middle, fallen):
    """Return the begin and the end of the slopes around a place, equal if they are those of noise."""
    begin, end = middle, middle + 1
    while begin > 0 and around[begin - 1] <= around[begin]:
        begin -= 1
    while end < len(around) and around[end] <= around[end - 1]:
        end += 1
    if min(around[begin], around[end - 1]) > fallen * around[middle]:
        return 0, 0
    return begin, end


@njit(nogil=True, cache=True, error_model="numpy")
def _ranked(values, count, rank):
    """Return the value with a rank, after C. A. R. Hoare, Algorithm 65: Find, 1961; their order is lost."""
    first, last = 0, count - 1
    while first < last:
        pivot, i, j = values[(first + last) // 2], first, last
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        first, last = first if rank <= j else i, j if rank <= j else last
        if j < rank < first:
            break
    return values[rank]
