"""Beams of few nodes by delay-and-sum, beams of all directions from those near by; in single precision."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.delay_and_sum import beams_from
from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._cuda.terms import BLOCK, DIRECTIONS, TILE, WARP, beam_grid
from ertis_numba.kernels._scalar import imag_of, magnitude, real_of

__all__ = ["interpolated_beams_envelope"]

_ONE, _1, _2, _3 = np.uint64(1), np.uint64(WARP), np.uint64(2 * WARP), np.uint64(3 * WARP)


@cuda.jit(device=True)
def _add_node(nodes, at, weight, sums):
    """Return the sums of both parts of four ranges, a warp apart, with a node's added."""
    a_real, a_imag, b_real, b_imag, c_real, c_imag, d_real, d_imag = sums
    a, b, c, d = nodes[at], nodes[at + _1], nodes[at + _2], nodes[at + _3]
    return (
        a_real + weight * real_of(a),
        a_imag + weight * imag_of(a),
        b_real + weight * real_of(b),
        b_imag + weight * imag_of(b),
        c_real + weight * real_of(c),
        c_imag + weight * imag_of(c),
        d_real + weight * real_of(d),
        d_imag + weight * imag_of(d),
    )


@cuda.jit(cache=True)
def _interpolate(nodes, width, places, tap_weights, rows, first, stop, out):
    """``nodes`` are (node, range) uint64, flat; their ``width`` is a whole number of tiles."""
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(places.shape[0]):
        return
    k = np.uint32(cuda.blockIdx.y * TILE + cuda.threadIdx.x)
    zero = np.float32(0)
    sums = zero, zero, zero, zero, zero, zero, zero, zero
    n_pairs = np.uint64(places.shape[1])
    pair = np.uint64(0)
    while pair < n_pairs:
        at = np.uint64(places[direction, pair]) * np.uint64(width) + k
        weights = tap_weights[direction, pair]
        pair += _ONE
        sums = _add_node(nodes, at, real_of(weights), sums)
        sums = _add_node(nodes, at + np.uint64(width), imag_of(weights), sums)
    a_real, a_imag, b_real, b_imag, c_real, c_imag, d_real, d_imag = sums
    row = np.uint64(rows[direction])
    r = np.uint64(first) + k
    end = np.uint64(stop)
    if r < end:
        out[row, r] = magnitude(a_real, a_imag)
    if r + _1 < end:
        out[row, r + _1] = magnitude(b_real, b_imag)
    if r + _2 < end:
        out[row, r + _2] = magnitude(c_real, c_imag)
    if r + _3 < end:
        out[row, r + _3] = magnitude(d_real, d_imag)


def interpolated_beams_envelope(signals, offsets, weights, places, tap_weights, rows, first, stop, n_blocks, out):
    """See `InterpolatedBeamsEnvelope`."""
    n_directions, n_pairs = places.shape
    grid = beam_grid(n_directions, stop - first)
    width = grid[1] * TILE
    nodes = workspace(f"nodes from range {first} on", (offsets.shape[0], width), np.uint64)
    beams_from(signals, offsets, weights, first, stop - first, nodes)
    pairs = tap_weights.reshape(-1).view(np.uint64).reshape(n_directions, n_pairs)
    launch(_interpolate, grid, BLOCK, nodes.reshape(-1), width, places, pairs, rows, first, stop, out)
