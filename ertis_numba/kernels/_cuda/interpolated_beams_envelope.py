"""Beams on a coarse grid by delay-and-sum, interpolated to all directions, in single precision."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import BLOCK, DIRECTIONS, ONE, TILE, WARPS_1, WARPS_2, WARPS_3, beam_grid
from ertis_numba.kernels._cuda.delay_and_sum import beams_from
from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._scalar import imag_of, magnitude, real_of

__all__ = ["interpolated_beams_envelope"]


@cuda.jit(device=True)
def _add_node(nodes, at, weight, sums):
    """Return the sums of both parts of four ranges, a warp apart, with those of a grid point added."""
    a_real, a_imag, b_real, b_imag, c_real, c_imag, d_real, d_imag = sums
    a, b, c, d = nodes[at], nodes[at + WARPS_1], nodes[at + WARPS_2], nodes[at + WARPS_3]
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
def _interpolate(nodes, width, places, n_pairs, tap_weights, rows, first, stop, out):
    """Fill ranges of ``out`` from flat tables and nodes (point, ``width``), which is a multiple of the tile."""
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(rows.size):
        return
    k, row_width = np.uint64(cuda.blockIdx.y * TILE + cuda.threadIdx.x), np.uint64(width)
    zero = np.float32(0)
    sums = zero, zero, zero, zero, zero, zero, zero, zero
    entry = direction * np.uint64(n_pairs)
    end_entry = entry + np.uint64(n_pairs)
    while entry < end_entry:
        at = np.uint64(np.uint32(places[entry])) * row_width + k
        weights = tap_weights[entry]
        entry += ONE
        sums = _add_node(nodes, at, real_of(weights), sums)
        sums = _add_node(nodes, at + row_width, imag_of(weights), sums)
    a_real, a_imag, b_real, b_imag, c_real, c_imag, d_real, d_imag = sums
    row = np.uint64(rows[direction])
    r = np.uint64(first) + k
    end = np.uint64(stop)
    if r < end:
        out[row, r] = magnitude(a_real, a_imag)
    if r + WARPS_1 < end:
        out[row, r + WARPS_1] = magnitude(b_real, b_imag)
    if r + WARPS_2 < end:
        out[row, r + WARPS_2] = magnitude(c_real, c_imag)
    if r + WARPS_3 < end:
        out[row, r + WARPS_3] = magnitude(d_real, d_imag)


def interpolated_beams_envelope(signals, offsets, weights, places, tap_weights, rows, first, stop, n_blocks, out):
    """Compute beams on a coarse beam grid, interpolate the beams of all directions, and take their envelopes."""
    grid = beam_grid(places.shape[0], stop - first)
    width = grid[1] * TILE
    nodes = workspace(f"nodes from range {first} on", (offsets.shape[0], width), np.uint64)
    beams_from(signals, offsets, weights, first, stop - first, nodes)
    tables = places.reshape(-1), places.shape[1], tap_weights.reshape(-1).view(np.uint64), rows
    launch(_interpolate, grid, BLOCK, nodes.reshape(-1), width, *tables, first, stop, out)
