"""Sums over the terms of a beam.

A warp handles one direction, and each thread `RANGES_PER_THREAD` ranges that are a warp apart. Complex numbers are
uint64, which take one load, and indices are unsigned, which Numba does not test for negative numbers.
"""

import numpy as np
from numba import cuda

from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels._scalar import imag_of, real_of

__all__ = [
    "BLOCK",
    "DIRECTIONS",
    "ONE",
    "TILE",
    "WARP",
    "WARPS_1",
    "WARPS_2",
    "WARPS_3",
    "beam_grid",
    "complexes",
    "fill_beams",
    "indexed",
]

WARP = 32
DIRECTIONS = 4
BLOCK = (WARP, DIRECTIONS)
RANGES_PER_THREAD = 4
TILE = RANGES_PER_THREAD * WARP
ONE, WARPS_1, WARPS_2, WARPS_3 = np.uint64(1), np.uint64(WARP), np.uint64(2 * WARP), np.uint64(3 * WARP)

_MAX_INDEXED = 2**32 - 1


def complexes(array):
    """Return complex64 numbers as a flat array of uint64."""
    return indexed(array.reshape(-1).view(np.uint64))


def indexed(array):
    """Return a flat array unchanged after checking that 32-bit indices suffice, as kernels assume."""
    if array.size > _MAX_INDEXED:
        raise DeviceError(
            f"device 'cuda' would have to index {array.size:,} numbers; the limit is {_MAX_INDEXED:,}. "
            "Use a shorter record or range, or device 'cpu'"
        )
    return array


def beam_grid(n_directions, n_ranges):
    """Return the number of blocks for an image along both axes; adjacent blocks read the same tile of signals."""
    return -(-n_directions // DIRECTIONS), -(-n_ranges // TILE)


@cuda.jit(device=True)
def _sum_tile(signals, offsets, weights, n_terms, direction, place):
    """Return the real and imaginary parts of a beam at ``place``, and one, two and three warps further."""
    a_real = a_imag = b_real = b_imag = c_real = c_imag = d_real = d_imag = np.float32(0)
    entry = direction * n_terms
    end = entry + n_terms
    while entry < end:
        weight = weights[entry]
        at = np.uint32(place + offsets[entry])  # with 32 bits, an address is one instruction
        entry += ONE
        w_real, w_imag = real_of(weight), imag_of(weight)
        a, b, c, d = signals[at], signals[at + WARPS_1], signals[at + WARPS_2], signals[at + WARPS_3]
        a_real = (a_real + real_of(a) * w_real) - imag_of(a) * w_imag
        a_imag = (a_imag + real_of(a) * w_imag) + imag_of(a) * w_real
        b_real = (b_real + real_of(b) * w_real) - imag_of(b) * w_imag
        b_imag = (b_imag + real_of(b) * w_imag) + imag_of(b) * w_real
        c_real = (c_real + real_of(c) * w_real) - imag_of(c) * w_imag
        c_imag = (c_imag + real_of(c) * w_imag) + imag_of(c) * w_real
        d_real = (d_real + real_of(d) * w_real) - imag_of(d) * w_imag
        d_imag = (d_imag + real_of(d) * w_imag) + imag_of(d) * w_real
    return a_real, a_imag, b_real, b_imag, c_real, c_imag, d_real, d_imag


@cuda.jit(device=True)
def _sum_terms(signals, offsets, weights, n_terms, direction, place):
    """Return the real and the imaginary part of a beam at ``place``."""
    real = imag = np.float32(0)
    entry = direction * n_terms
    end = entry + n_terms
    while entry < end:
        weight, sample = weights[entry], signals[np.uint32(place + offsets[entry])]
        entry += ONE
        w_real, w_imag = real_of(weight), imag_of(weight)
        real = (real + real_of(sample) * w_real) - imag_of(sample) * w_imag
        imag = (imag + real_of(sample) * w_imag) + imag_of(sample) * w_real
    return real, imag


@cuda.jit(device=True)
def fill_beams(value_of, signals, offsets, weights, n_terms, origin, first, stop, end, out):
    """Write ``value_of(real, imag)`` of a thread's beams from ``first`` to ``stop``, and of 0 to ``end``."""
    # `origin` is the position in the signals of the first range of `out`.
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(out.shape[0]):
        return
    terms = np.uint64(n_terms)
    tile = np.int64(first + cuda.blockIdx.y * TILE)
    place = tile + cuda.threadIdx.x
    if tile + TILE <= stop:
        a_real, a_imag, b_real, b_imag, c_real, c_imag, d_real, d_imag = _sum_tile(
            signals, offsets, weights, terms, direction, origin + place
        )
        r = np.uint64(place)
        out[direction, r] = value_of(a_real, a_imag)
        out[direction, r + WARPS_1] = value_of(b_real, b_imag)
        out[direction, r + WARPS_2] = value_of(c_real, c_imag)
        out[direction, r + WARPS_3] = value_of(d_real, d_imag)
    else:
        while place < stop:
            real, imag = _sum_terms(signals, offsets, weights, terms, direction, origin + place)
            out[direction, np.uint64(place)] = value_of(real, imag)
            place += WARP
        while stop < end and place < end:  # if both are the same argument, the compiler removes this loop
            out[direction, np.uint64(place)] = value_of(np.float32(0), np.float32(0))
            place += WARP
