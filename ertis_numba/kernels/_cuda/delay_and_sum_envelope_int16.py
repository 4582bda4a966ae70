"""Delay-and-sum and envelope on 16-bit samples, with half the bytes per point of the float32 kernel and exact sums."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import BLOCK, DIRECTIONS, ONE, WARP, WARPS_1, WARPS_2, indexed
from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import magnitude, short_imag_of, short_real_of

__all__ = ["TILE_RANGES", "delay_and_sum_envelope_int16", "store_tile", "sum_short_terms"]

TILE_RANGES = 3 * WARP


@cuda.jit(device=True)
def sum_short_terms(samples, offsets, weights, n_terms, direction, place):
    """Return both parts of a beam at ``place``, and one and two warps further, from flat pairs of int16 as uint32."""
    a_real = a_imag = b_real = b_imag = c_real = c_imag = np.int32(0)
    entry = direction * n_terms
    end = entry + n_terms
    while entry < end:
        upper, lower = weights[entry + entry], weights[entry + entry + ONE]
        at = np.uint32(place + offsets[entry])
        entry += ONE
        p, q, s, t = short_real_of(upper), short_imag_of(upper), short_real_of(lower), short_imag_of(lower)
        # Cast to 32 bits at each step, because Numba widens sums of 32-bit integers to 64 bits.
        x = samples[at]
        x_real, x_imag = short_real_of(x), short_imag_of(x)
        a_real = np.int32(np.int32(a_real + p * x_real) + q * x_imag)
        a_imag = np.int32(np.int32(a_imag + s * x_real) + t * x_imag)
        x = samples[at + WARPS_1]
        x_real, x_imag = short_real_of(x), short_imag_of(x)
        b_real = np.int32(np.int32(b_real + p * x_real) + q * x_imag)
        b_imag = np.int32(np.int32(b_imag + s * x_real) + t * x_imag)
        x = samples[at + WARPS_2]
        x_real, x_imag = short_real_of(x), short_imag_of(x)
        c_real = np.int32(np.int32(c_real + p * x_real) + q * x_imag)
        c_imag = np.int32(np.int32(c_imag + s * x_real) + t * x_imag)
    return a_real, a_imag, b_real, b_imag, c_real, c_imag


@cuda.jit(device=True)
def store_tile(out, row, start, stop, scale, sums):
    """Write the magnitudes of a thread's sums of a tile that starts at range ``start``, up to ``stop``."""
    a_real, a_imag, b_real, b_imag, c_real, c_imag = sums
    r, end = np.uint64(start + cuda.threadIdx.x), np.uint64(stop)
    if r < end:
        out[row, r] = magnitude(np.float32(a_real), np.float32(a_imag)) * scale
    if r + WARPS_1 < end:
        out[row, r + WARPS_1] = magnitude(np.float32(b_real), np.float32(b_imag)) * scale
    if r + WARPS_2 < end:
        out[row, r + WARPS_2] = magnitude(np.float32(c_real), np.float32(c_imag)) * scale


@cuda.jit(cache=True)
def _fill(samples, per_tile, scales, starts, stop, offsets, weights, n_terms, weight_scale, out):
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(out.shape[0]):
        return
    tile = np.uint64(cuda.blockIdx.y)
    place = cuda.blockIdx.y * np.int64(per_tile) + cuda.threadIdx.x
    sums = sum_short_terms(samples, offsets, weights, np.uint64(n_terms), direction, place)
    store_tile(out, direction, starts[tile], stop, np.float32(scales[tile] * weight_scale), sums)


def delay_and_sum_envelope_int16(tiles, scales, starts, stop, offsets, weights, weight_scale, out):
    """`DelayAndSumEnvelope` on the tiles of `QuantiseTiles`, with integer sums."""
    n_directions, n_terms = offsets.shape
    n_tiles = tiles.shape[0]
    samples = indexed(tiles.reshape(-1).view(np.uint32))
    launch(
        _fill,
        (-(-n_directions // DIRECTIONS), n_tiles),
        BLOCK,
        samples,
        samples.shape[0] // n_tiles,
        scales,
        starts,
        stop,
        offsets.reshape(-1),
        weights.reshape(-1).view(np.uint32),
        n_terms,
        weight_scale,
        out,
    )
