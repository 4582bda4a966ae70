"""Beams on a coarse grid by delay-and-sum, interpolated to all directions, in single precision.

The grid beams of a tile stay in the L2 cache between the two steps.
"""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot32 import FLOAT, TILE, Dot32, Planes
from ertis_numba.kernels._cpu.spans import node_span

__all__ = ["interpolated_beams_envelope"]


@intrinsic
def _node_tile(typing_context, signals, offsets, weights, node, first, rows, row):
    """Fill ``rows[row]``, (part, range) float32, with the beam of a grid point."""
    signature = types.void(signals, offsets, weights, types.intp, types.intp, rows, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        dot = Dot32(builder)
        dot.complex_terms(array(0), array(1), array(2), arguments[3], arguments[4])
        size = ir.Constant(arguments[6].type, 2 * TILE)
        dot.store_parts(builder.gep(array(5).data, [builder.mul(arguments[6], size)]))
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def _interpolate_tile(typing_context, rows, skipped, places, weights, direction, out, place):
    """Fill ``out.flat[place : place + TILE]`` from ``rows``, (point, part, range), whose first point is ``skipped``."""
    signature = types.void(rows, types.intp, places, weights, types.intp, out, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        direction = arguments[4]
        n_pairs = cgutils.unpack_tuple(builder, array(2).shape)[1]
        values = builder.bitcast(array(3).data, FLOAT.as_pointer())
        first_pair = builder.mul(direction, n_pairs)
        one = ir.Constant(direction.type, 1)
        planes = Planes(builder)
        with cgutils.for_range(builder, n_pairs) as loop:
            entry = builder.add(first_pair, loop.index)
            node = builder.sext(builder.load(builder.gep(array(2).data, [entry])), direction.type)
            node = builder.sub(node, arguments[1])
            even = builder.shl(entry, one)
            planes.add(array(0).data, node, values, even)
            planes.add(array(0).data, builder.add(node, one), values, builder.add(even, one))
        planes.store_levels(builder.gep(array(5).data, [arguments[6]]))
        return context.get_dummy_value()

    return signature, codegen


@njit(parallel=True, nogil=True, cache=True)
def interpolated_beams_envelope(signals, offsets, weights, places, tap_weights, rows, first, stop, n_blocks, out):
    """Compute beams on a coarse beam grid, interpolate the beams of all directions, and take their envelopes."""
    n_directions, n_ranges = out.shape
    n_tiles = (stop - first + TILE - 1) // TILE
    block = (n_directions + n_blocks - 1) // n_blocks
    for part in prange(n_tiles * n_blocks):
        # The last tile overlaps the previous one; a tile that is longer than its focal zone begins before the zone.
        at = max(0, min(first + part // n_blocks * TILE, stop - TILE))
        begin = min(part % n_blocks * block, n_directions)
        end = min(begin + block, n_directions)
        if begin == end:
            continue
        lowest, highest = node_span(places, begin, end)
        nodes = np.empty((highest + 1 - lowest, 2, TILE), np.float32)
        for node in range(nodes.shape[0]):
            _node_tile(signals, offsets, weights, lowest + node, at, nodes, node)
        short = np.empty((1, TILE), np.float32)
        for direction in range(begin, end):
            if at < first or at + TILE > stop:
                begin_range, end_range = max(first, at), min(stop, at + TILE)
                _interpolate_tile(nodes, lowest, places, tap_weights, direction, short, 0)
                out[rows[direction], begin_range:end_range] = short[0, begin_range - at : end_range - at]
            else:
                place = rows[direction] * np.int64(n_ranges) + at
                _interpolate_tile(nodes, lowest, places, tap_weights, direction, out, place)
