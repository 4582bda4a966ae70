"""Sum the delayed and weighted signals of all microphones for every direction and range."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._cuda.terms import (
    BLOCK,
    DIRECTIONS,
    TILE,
    WARP,
    beam_grid,
    complexes,
    sum_term_tile,
    sum_terms,
)
from ertis_numba.kernels._scalar import sample_of

__all__ = ["beams_from", "delay_and_sum"]

_1, _2, _3 = np.uint64(WARP), np.uint64(2 * WARP), np.uint64(3 * WARP)


@cuda.jit(cache=True)
def _fill(signals, offsets, weights, n_terms, first, n_ranges, out):
    """``out``, (direction, range) uint64, has its first range at ``first``; past ``n_ranges`` it is filled with 0."""
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(out.shape[0]):
        return
    terms = np.uint64(n_terms)
    begin = np.int64(cuda.blockIdx.y * TILE)
    place = begin + cuda.threadIdx.x
    if begin + TILE <= n_ranges:
        a_real, a_imag, b_real, b_imag, c_real, c_imag, d_real, d_imag = sum_term_tile(
            signals, offsets, weights, terms, direction, first + place
        )
        r = np.uint64(place)
        out[direction, r] = sample_of(a_real, a_imag)
        out[direction, r + _1] = sample_of(b_real, b_imag)
        out[direction, r + _2] = sample_of(c_real, c_imag)
        out[direction, r + _3] = sample_of(d_real, d_imag)
    else:
        while place < n_ranges:
            real, imag = sum_terms(signals, offsets, weights, terms, direction, first + place)
            out[direction, np.uint64(place)] = sample_of(real, imag)
            place += WARP
        while place < out.shape[1]:
            out[direction, np.uint64(place)] = np.uint64(0)
            place += WARP


def beams_from(signals, offsets, weights, first, n_ranges, out):
    """Do `delay_and_sum` for ``n_ranges`` ranges from ``first`` on.

    ``out`` is (direction, range) uint64, and may end less than a tile later: there it becomes 0.
    """
    grid, tables = beam_grid(out.shape[0], n_ranges), (offsets.reshape(-1), complexes(weights))
    launch(_fill, grid, BLOCK, complexes(signals), *tables, offsets.shape[1], first, n_ranges, out)


def delay_and_sum(signals, offsets, weights, out):
    """See `DelayAndSum`."""
    beams_from(signals, offsets, weights, 0, out.shape[1], out.view(np.uint64))
