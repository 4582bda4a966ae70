# mypy: ignore-errors
"""Amplitudes from delay-and-sums of streams on 16-bit samples.

The number of streams is known only at run time, and sums in registers need loops of constant length.
"""

import functools
import math

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import BLOCK, DIRECTIONS, WARP, WARPS_1, WARPS_2, indexed
from ertis_numba.kernels._cuda.delay_and_sum_envelope_int16 import TILE_RANGES, sum_short_terms
from ertis_numba.kernels._cuda.interpolated_beams_envelope_int16 import fill_nodes, sum_short_nodes
from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._scalar import imag_of, power, real_of, sample_of

__all__ = ["combine_streams_int16"]


@cuda.jit(device=True)
def _store(sums, stream, direction, tile, scale, found):
    """Write a thread's sums, (stream, direction, tile · range) uint64."""
    a_real, a_imag, b_real, b_imag, c_real, c_imag = found
    k = tile * np.uint64(TILE_RANGES) + np.uint64(cuda.threadIdx.x)
    sums[stream, direction, k] = sample_of(np.float32(a_real) * scale, np.float32(a_imag) * scale)
    sums[stream, direction, k + WARPS_1] = sample_of(np.float32(b_real) * scale, np.float32(b_imag) * scale)
    sums[stream, direction, k + WARPS_2] = sample_of(np.float32(c_real) * scale, np.float32(c_imag) * scale)


@cuda.jit(cache=True)
def _sum_terms(samples, per_tile, scales, stream, offsets, weights, n_terms, sums):
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(sums.shape[1]):
        return
    tile, of = np.uint64(cuda.blockIdx.y), np.uint64(stream)
    place = cuda.blockIdx.y * np.int64(per_tile) + cuda.threadIdx.x
    found = sum_short_terms(samples, offsets, weights, np.uint64(n_terms), direction, place)
    _store(sums, of, direction, tile, scales[tile, of], found)


@cuda.jit(cache=True)
def _sum_nodes(nodes, n_nodes, scales, stream, places, n_pairs, tap_weights, sums):
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(sums.shape[1]):
        return
    tile, of = np.uint64(cuda.blockIdx.y), np.uint64(stream)
    found = sum_short_nodes(nodes, n_nodes, places, n_pairs, tap_weights, direction)
    _store(sums, of, direction, tile, scales[tile, of], found)


@cuda.jit(device=True)
def _factor(coherent, total, unit, n_mics):
    """Return the coherence factor; interpolation may leave slightly less power than the beam has."""
    power, root = real_of(total), imag_of(total)
    if unit > np.float32(0):
        power = max(power, n_mics * root * root / unit)
    if coherent > np.float32(0):
        return coherent / max(n_mics * power, coherent)
    return np.float32(0)


@functools.cache
def _kernel_of(n_powers, order, beam, total):
    """Return the kernel that combines the sums of a recipe."""
    size = order + 1  # a constant of the compiler

    @cuda.jit(cache=True)
    def combine(sums, scales, starts, stop, n_mics, bound, rows, out):
        direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
        tile = np.uint64(cuda.blockIdx.y)
        if direction >= np.uint64(rows.size):
            return
        k = np.int64(cuda.blockIdx.z * WARP + cuda.threadIdx.x)
        place = starts[tile] + k
        if place >= stop:
            return
        at = tile * np.uint64(TILE_RANGES) + np.uint64(k)
        # Power sums and elementary symmetric polynomials.
        p_real = cuda.local.array(size, np.float32)
        p_imag = cuda.local.array(size, np.float32)
        real = cuda.local.array(size, np.float32)
        imag = cuda.local.array(size, np.float32)
        real[0], imag[0] = np.float32(1), np.float32(0)
        for i in range(1, order + 1):
            p_real[i] = p_imag[i] = np.float32(0)
            if i <= n_powers:
                value = sums[np.uint64(i - 1), direction, at]
                p_real[i], p_imag[i] = real_of(value), imag_of(value)
        for i in range(1, order + 1):
            x = y = np.float32(0)
            sign = np.float32(1)
            for j in range(1, order + 1):
                if j <= i:
                    a, b = sign * real[i - j], sign * imag[i - j]
                    x = (x + a * p_real[j]) - b * p_imag[j]
                    y = (y + a * p_imag[j]) + b * p_real[j]
                    sign = -sign
            share = np.float32(1) / np.float32(i)
            real[i], imag[i] = x * share, y * share
        level = np.float32(math.sqrt(power(real[order], imag[order])))
        if total >= 0:
            value = sums[np.uint64(beam), direction, at]
            coherent = power(real_of(value), imag_of(value))
            unit = scales[tile, np.uint64(total)] * bound
            level *= _factor(coherent, sums[np.uint64(total), direction, at], unit, n_mics)
        out[np.uint64(rows[direction]), np.uint64(place)] = level

    return combine


def combine_streams_int16(
    tiles, scales, starts, stop, shapes, offsets, weights, places, tap_weights, rows, recipe, out
):
    """Compute amplitudes from delay-and-sums of streams on 16-bit tiles."""
    n_tiles, n_streams, n_mics = tiles.shape[:3]
    samples = indexed(tiles.reshape(-1).view(np.uint32))
    per_tile = samples.shape[0] // n_tiles
    n_directions = out.shape[0]
    sums = workspace(f"sums of {n_tiles} tiles", (n_streams, n_directions, n_tiles * TILE_RANGES), np.uint64)
    flat_weights, flat_taps = weights.reshape(-1).view(np.uint32), tap_weights.reshape(-1).view(np.uint32)
    grid = -(-n_directions // DIRECTIONS), n_tiles
    entry = pair = 0
    for stream, (n_points, n_terms, n_pairs) in enumerate(shapes.tolist()):
        mine = samples[stream * (per_tile // n_streams) :]
        size = n_points * n_terms
        table = offsets[entry : entry + size], flat_weights[2 * entry : 2 * (entry + size)]
        if n_pairs:
            nodes = workspace(f"nodes of {n_tiles} tiles", (n_tiles, n_points, TILE_RANGES), np.uint32)
            launch(fill_nodes, (-(-n_points // DIRECTIONS), n_tiles), BLOCK, mine, per_tile, *table, n_terms, nodes)
            part = slice(pair, pair + n_directions * n_pairs)
            near = places[part], n_pairs, flat_taps[part]
            launch(_sum_nodes, grid, BLOCK, nodes.reshape(-1), n_points, scales, stream, *near, sums)
            pair += n_directions * n_pairs
        else:
            launch(_sum_terms, grid, BLOCK, mine, per_tile, scales, stream, *table, n_terms, sums)
        entry += size
    *numbers, bound = recipe
    numbers_of_tiles = sums, scales, starts, stop, np.float32(n_mics), np.float32(bound)
    launch(_kernel_of(*map(int, numbers)), (*grid, TILE_RANGES // WARP), BLOCK, *numbers_of_tiles, rows, out)
