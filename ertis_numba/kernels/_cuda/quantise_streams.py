# mypy: ignore-errors
"""Compute streams of analytic signals, and store them in 16 bits in tiles of ranges."""

import math

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._cuda.quantise_tiles import BLOCK, ROWS, largest_of_tiles
from ertis_numba.kernels._scalar import imag_of, power, real_of, short_sample_of

__all__ = ["quantise_streams"]

_WARP = BLOCK[0]


@cuda.jit(device=True)
def _stream_of(sample, inverse, exponent, turns, limit):
    """Return a sample of a stream, relative to the largest one of its tile, times ``limit``."""
    real, imag = real_of(sample) * inverse, imag_of(sample) * inverse
    level = math.sqrt(power(real, imag))
    if level == np.float32(0):
        return np.float32(0), np.float32(0)
    real, imag = real / level, imag / level
    x, y = limit * level**exponent, np.float32(0)
    turn = np.int32(0)
    while turn < turns:
        x, y = x * real - y * imag, x * imag + y * real
        turn = np.int32(turn + 1)
    if turns == np.int32(0):
        y = limit * level ** (np.float32(0.5) * exponent)
    return x, y


@cuda.jit(cache=True)
def _round(signals, starts, limits, units, powers, turns, first, bits, tiles, scales):
    """Fill ``tiles``, (tile, stream, row, k) uint32, with real parts in the lower halves and imaginary in the upper."""
    tile, stream = np.uint64(cuda.blockIdx.y), np.uint64(cuda.blockIdx.z + first)
    row = np.uint64(cuda.blockIdx.x * ROWS + cuda.threadIdx.y)
    if row >= np.uint64(tiles.shape[2]):
        return
    largest = np.float32(math.sqrt(np.int32(bits[tile]).view(np.float32)))
    limit, exponent = limits[stream], powers[stream]
    k = np.int64(cuda.threadIdx.x)
    if row == np.uint64(0) and k == np.int64(0):
        scales[tile, stream] = largest**exponent / limit * units[stream]
    inverse = np.float32(0)
    if largest != np.float32(0):
        inverse = np.float32(1) / largest
    begin = np.int64(starts[tile])
    while k < tiles.shape[3]:
        value = np.uint32(0)
        if begin + k < signals.shape[1]:
            x, y = _stream_of(signals[row, np.uint64(begin + k)], inverse, exponent, turns[stream], limit)
            value = short_sample_of(x, y)
        tiles[tile, stream, row, np.uint64(k)] = value
        k += _WARP


def quantise_streams(signals, starts, limits, units, powers, turns, first, stop, tiles, scales):
    """Compute streams of analytic signals, and store them like `QuantiseTiles`."""
    n_tiles, n_streams, n_mics, n_phases, width, _ = tiles.shape
    n_rows = n_mics * n_phases
    samples = signals.view(np.uint64).reshape(n_rows, signals.shape[2])
    bits = largest_of_tiles(samples, starts, n_tiles, width)
    rounded = tiles.reshape(n_tiles, n_streams, n_rows, 2 * width).view(np.uint32)
    grid = -(-n_rows // ROWS), n_tiles, stop - first
    launch(_round, grid, BLOCK, samples, starts, limits, units, powers, turns, first, bits, rounded, scales)
