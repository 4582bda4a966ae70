"""Delay-and-sum and envelope in one pass, with the sums in registers."""

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
from ertis_numba.kernels._scalar import magnitude

__all__ = ["delay_and_sum_envelope"]

_1, _2, _3 = np.uint64(WARP), np.uint64(2 * WARP), np.uint64(3 * WARP)


@cuda.jit(cache=True)
def _fill(signals, offsets, weights, n_terms, first, stop, out):
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(out.shape[0]):
        return
    terms = np.uint64(n_terms)
    begin = np.int64(first + cuda.blockIdx.y * TILE)
    place = begin + cuda.threadIdx.x
    if begin + TILE <= stop:
        a_real, a_imag, b_real, b_imag, c_real, c_imag, d_real, d_imag = sum_term_tile(
            signals, offsets, weights, terms, direction, place
        )
        r = np.uint64(place)
        out[direction, r] = magnitude(a_real, a_imag)
        out[direction, r + _1] = magnitude(b_real, b_imag)
        out[direction, r + _2] = magnitude(c_real, c_imag)
        out[direction, r + _3] = magnitude(d_real, d_imag)
    else:
        while place < stop:
            real, imag = sum_terms(signals, offsets, weights, terms, direction, place)
            out[direction, np.uint64(place)] = magnitude(real, imag)
            place += WARP


def delay_and_sum_envelope(signals, offsets, weights, first, stop, out):
    """See `DelayAndSumEnvelope`."""
    grid, tables = beam_grid(out.shape[0], stop - first), (offsets.reshape(-1), complexes(weights))
    launch(_fill, grid, BLOCK, complexes(signals), *tables, offsets.shape[1], first, stop, out)
