"""Beams on a coarse grid by delay-and-sum, interpolated to all directions, on 16-bit samples.

Both steps use the CPU's 16-bit dot product. In the second step, a pair consists of two neighbouring grid points at one
range. An instruction therefore adds two grid points at once, and loads never cross a cache line. The grid beams of a
tile stay in the L2 cache between the steps.
"""

import numpy as np
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot16 import RANGES, Dot16
from ertis_numba.kernels._cpu.nodes16 import fill_pairs, new_pairs
from ertis_numba.kernels._cpu.spans import node_span

__all__ = ["interpolated_beams_envelope_int16"]


@intrinsic
def _interpolate_tile(typing_context, pairs, skipped, places, weights, direction, scale, out, place):
    """Fill ``out.flat[place : place + RANGES]`` from the pairs of grid points around ``direction``.

    ``pairs`` is (point, part, range) int32, and its first point is ``skipped``. Each number holds a grid point in its
    low 16 bits and the next one in its high 16 bits.
    """
    signature = types.void(pairs, types.intp, places, weights, types.intp, types.float32, out, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        n_pairs = cgutils.unpack_tuple(builder, array(2).shape)[1]
        first_pair = builder.mul(arguments[4], n_pairs)
        dot = Dot16(builder)
        dot.node_pairs(array(0).data, arguments[1], array(2), array(3), first_pair, n_pairs)
        dot.store_levels(arguments[5], builder.gep(array(6).data, [arguments[7]]))
        return context.get_dummy_value()

    return signature, codegen


@njit(parallel=True, nogil=True, cache=True)
def interpolated_beams_envelope_int16(
    tiles, scales, starts, stop, offsets, weights, places, tap_weights, rows, weight_scale, n_blocks, out
):
    """`InterpolatedBeamsEnvelope` on the tiles of `QuantiseTiles`, with integer sums."""
    n_directions, n_ranges = out.shape
    n_tiles = tiles.shape[0]
    block = (n_directions + n_blocks - 1) // n_blocks
    for part in prange(n_tiles * n_blocks):
        tile = part // n_blocks
        begin = min(part % n_blocks * block, n_directions)
        end = min(begin + block, n_directions)
        if begin == end:
            continue
        first, last = node_span(places, begin, end)
        pairs = new_pairs(last - first + 1)
        fill_pairs(tiles, tile, offsets, weights, first, last, pairs)
        scale = scales[tile] * weight_scale
        short = np.empty((1, RANGES), np.float32)
        for direction in range(begin, end):
            if starts[tile] + RANGES > stop:
                _interpolate_tile(pairs, first, places, tap_weights, direction, scale, short, 0)
                out[rows[direction], starts[tile] : stop] = short[0, : stop - starts[tile]]
            else:
                place = rows[direction] * np.int64(n_ranges) + starts[tile]
                _interpolate_tile(pairs, first, places, tap_weights, direction, scale, out, place)
