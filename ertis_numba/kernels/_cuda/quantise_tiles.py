"""Split analytic signals into tiles of ranges, and store each in 16 bits with its own scale."""

import math

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._scalar import imag_of, power, real_of, short_sample_of

__all__ = ["BLOCK", "ROWS", "largest_of_tiles", "quantise_tiles"]

_WARP, ROWS = 32, 4  # threads of a block along its two axes
BLOCK = _WARP, ROWS
_ROWS_PER_THREAD = 8  # in the search for the largest power, because all threads update one number in the end


@cuda.jit(cache=True)
def _clear(bits):
    tile = cuda.grid(1)
    if tile < bits.size:
        bits[tile] = np.int32(0)


@cuda.jit(cache=True)
def _find_largest(signals, starts, width, bits):
    """Fill ``bits`` with the largest squared magnitudes; non-negative floats have the same order as their bits."""
    tile = np.uint64(cuda.blockIdx.y)
    row = np.int64(cuda.blockIdx.x * ROWS * _ROWS_PER_THREAD + cuda.threadIdx.y)
    begin = np.int64(starts[tile])
    end = min(begin + width, np.int64(signals.shape[1]))
    last = min(row + ROWS * _ROWS_PER_THREAD, np.int64(signals.shape[0]))
    largest = np.int32(0)
    while row < last:
        sample = begin + cuda.threadIdx.x
        while sample < end:
            x = signals[np.uint64(row), np.uint64(sample)]
            largest = max(largest, np.float32(power(real_of(x), imag_of(x))).view(np.int32))
            sample += _WARP
        row += ROWS
    if largest > bits[tile]:  # most are not, and avoid the atomic operation
        cuda.atomic.max(bits, tile, largest)


@cuda.jit(cache=True)
def _round(signals, starts, limit, bits, tiles, scales):
    """Fill ``tiles``, (tile, row, k) uint32, with real parts in the lower halves and imaginary parts in the upper."""
    tile = np.uint64(cuda.blockIdx.y)
    row = np.uint64(cuda.blockIdx.x * ROWS + cuda.threadIdx.y)
    if row >= np.uint64(tiles.shape[1]):
        return
    largest = np.float32(math.sqrt(np.int32(bits[tile]).view(np.float32)))
    k = np.int64(cuda.threadIdx.x)
    if row == np.uint64(0) and k == np.int64(0):
        scales[tile] = largest / limit
    factor = np.float32(0)
    if largest != np.float32(0):
        factor = limit / largest
    begin = np.int64(starts[tile])
    while k < tiles.shape[2]:
        if begin + k < signals.shape[1]:
            x = signals[row, np.uint64(begin + k)]
            tiles[tile, row, np.uint64(k)] = short_sample_of(real_of(x) * factor, imag_of(x) * factor)
        else:
            tiles[tile, row, np.uint64(k)] = np.uint32(0)
        k += _WARP


def largest_of_tiles(samples, starts, n_tiles, width):
    """Return the bits of the largest squared magnitude of each tile, (tile,) int32, from (row, sample) uint64."""
    bits = workspace(f"largest of {n_tiles} tiles", (n_tiles,), np.int32)
    launch(_clear, (-(-n_tiles // _WARP),), (_WARP,), bits)
    grid = -(-samples.shape[0] // (ROWS * _ROWS_PER_THREAD)), n_tiles
    launch(_find_largest, grid, BLOCK, samples, starts, width, bits)
    return bits


def quantise_tiles(signals, starts, limit, tiles, scales):
    """Split analytic signals into tiles of ranges, and store each in 16 bits with its own scale."""
    n_tiles, n_mics, n_phases, width, _ = tiles.shape
    n_rows = n_mics * n_phases
    samples = signals.view(np.uint64).reshape(n_rows, signals.shape[2])
    bits = largest_of_tiles(samples, starts, n_tiles, width)
    rounded = tiles.reshape(n_tiles, n_rows, 2 * width).view(np.uint32)
    launch(_round, (-(-n_rows // ROWS), n_tiles), BLOCK, samples, starts, limit, bits, rounded, scales)
