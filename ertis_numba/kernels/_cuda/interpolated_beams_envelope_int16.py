"""Beams on a coarse grid by delay-and-sum, interpolated to all directions, on 16-bit samples."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import BLOCK, DIRECTIONS, ONE, WARPS_1, WARPS_2, indexed
from ertis_numba.kernels._cuda.delay_and_sum_envelope_int16 import TILE_RANGES, store_tile, sum_short_terms
from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._scalar import short_imag_of, short_real_of, upper_halves

__all__ = ["fill_nodes", "interpolated_beams_envelope_int16", "sum_short_nodes"]

_WIDTH = np.uint64(TILE_RANGES)


@cuda.jit(cache=True)
def fill_nodes(samples, per_tile, offsets, weights, n_terms, nodes):
    """Fill ``nodes``, (tile, point, range), with pairs of int16 as uint32."""
    node = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if node >= np.uint64(nodes.shape[1]):
        return
    tile, k = np.uint64(cuda.blockIdx.y), np.uint64(cuda.threadIdx.x)
    place = cuda.blockIdx.y * np.int64(per_tile) + cuda.threadIdx.x
    a_real, a_imag, b_real, b_imag, c_real, c_imag = sum_short_terms(
        samples, offsets, weights, np.uint64(n_terms), node, place
    )
    nodes[tile, node, k] = upper_halves(a_real, a_imag)
    nodes[tile, node, k + WARPS_1] = upper_halves(b_real, b_imag)
    nodes[tile, node, k + WARPS_2] = upper_halves(c_real, c_imag)


@cuda.jit(device=True)
def sum_short_nodes(nodes, n_nodes, places, n_pairs, tap_weights, direction):
    """Return both parts of an interpolated beam, and those one and two warps further, from pairs of int16 as uint32."""
    first = np.uint64(cuda.blockIdx.y * np.int64(n_nodes) * TILE_RANGES + cuda.threadIdx.x)
    a_real = a_imag = b_real = b_imag = c_real = c_imag = np.int32(0)
    entry = direction * np.uint64(n_pairs)
    end_entry = entry + np.uint64(n_pairs)
    while entry < end_entry:
        at = first + np.uint64(np.uint32(places[entry])) * _WIDTH
        weights = tap_weights[entry]
        entry += ONE
        low, high = short_real_of(weights), short_imag_of(weights)
        x, y = nodes[at], nodes[at + _WIDTH]
        a_real = np.int32(np.int32(a_real + low * short_real_of(x)) + high * short_real_of(y))
        a_imag = np.int32(np.int32(a_imag + low * short_imag_of(x)) + high * short_imag_of(y))
        x, y = nodes[at + WARPS_1], nodes[at + (_WIDTH + WARPS_1)]
        b_real = np.int32(np.int32(b_real + low * short_real_of(x)) + high * short_real_of(y))
        b_imag = np.int32(np.int32(b_imag + low * short_imag_of(x)) + high * short_imag_of(y))
        x, y = nodes[at + WARPS_2], nodes[at + (_WIDTH + WARPS_2)]
        c_real = np.int32(np.int32(c_real + low * short_real_of(x)) + high * short_real_of(y))
        c_imag = np.int32(np.int32(c_imag + low * short_imag_of(x)) + high * short_imag_of(y))
    return a_real, a_imag, b_real, b_imag, c_real, c_imag


@cuda.jit(cache=True)
def _interpolate(nodes, n_nodes, scales, starts, stop, places, n_pairs, tap_weights, rows, weight_scale, out):
    """Fill ranges of ``out``; arrays as for `sum_short_nodes`."""
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(rows.size):
        return
    tile = np.uint64(cuda.blockIdx.y)
    sums = sum_short_nodes(nodes, n_nodes, places, n_pairs, tap_weights, direction)
    row, scale = np.uint64(rows[direction]), np.float32(scales[tile] * weight_scale)
    store_tile(out, row, starts[tile], stop, scale, sums)


def interpolated_beams_envelope_int16(
    tiles, scales, starts, stop, offsets, weights, places, tap_weights, rows, weight_scale, n_blocks, out
):
    """`InterpolatedBeamsEnvelope` on the tiles of `QuantiseTiles`, with integer sums."""
    n_nodes, n_terms = offsets.shape
    n_directions, n_pairs = places.shape
    n_tiles = tiles.shape[0]
    samples = indexed(tiles.reshape(-1).view(np.uint32))
    nodes = workspace(f"nodes of {n_tiles} tiles", (n_tiles, n_nodes, TILE_RANGES), np.uint32)
    launch(
        fill_nodes,
        (-(-n_nodes // DIRECTIONS), n_tiles),
        BLOCK,
        samples,
        samples.shape[0] // n_tiles,
        offsets.reshape(-1),
        weights.reshape(-1).view(np.uint32),
        n_terms,
        nodes,
    )
    launch(
        _interpolate,
        (-(-n_directions // DIRECTIONS), n_tiles),
        BLOCK,
        nodes.reshape(-1),
        n_nodes,
        scales,
        starts,
        stop,
        places.reshape(-1),
        n_pairs,
        tap_weights.reshape(-1).view(np.uint32),
        rows,
        weight_scale,
        out,
    )
