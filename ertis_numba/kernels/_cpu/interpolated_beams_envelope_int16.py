"""Beams on a coarse grid by delay-and-sum, interpolated to all directions, on 16-bit samples.

An instruction adds two neighbouring grid points at one range, and loads never cross a cache line.
"""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot16 import INT32, RANGES, Dot16
from ertis_numba.kernels._cpu.grid_beams16 import fill_pairs, new_pairs
from ertis_numba.kernels._cpu.spans import node_span, prefetch_row, same_places

__all__ = ["interpolated_beams_envelope_int16"]


def _interpolation(n_beams):
    """Return an intrinsic that interpolates one direction, or two that share their grid points."""

    @intrinsic
    def interpolate(typing_context, pairs, skipped, places, weights, direction, scale, n_used, out, place, next_place):
        """Fill ``n_used`` to `RANGES` ranges of ``out.flat`` at ``place`` and ``next_place`` from `fill_pairs`."""
        integer = types.intp
        numbers = (integer, types.float32, integer)
        signature = types.void(pairs, integer, places, weights, *numbers, out, integer, integer)

        def codegen(context, builder, signature, arguments):
            def array(k):
                return context.make_array(signature.args[k])(context, builder, arguments[k])

            direction, size = arguments[4], arguments[4].type
            n_pairs = cgutils.unpack_tuple(builder, array(2).shape)[1]
            values = builder.bitcast(array(3).data, INT32.as_pointer())
            first_pair = builder.mul(direction, n_pairs)
            dot = Dot16(builder, n_beams)
            with dot.passes(arguments[6]) as first:
                with cgutils.for_range(builder, n_pairs) as loop:
                    entry = builder.add(first_pair, loop.index)
                    node = builder.sext(builder.load(builder.gep(array(2).data, [entry])), size)
                    begin = builder.mul(builder.sub(node, arguments[1]), ir.Constant(size, 2 * RANGES))
                    entries = [entry, builder.add(entry, n_pairs)][:n_beams]
                    dot.add_real_term(
                        array(0).data, builder.add(begin, first), [dot.pair(values, at) for at in entries]
                    )
                for beam in range(n_beams):
                    at = builder.add(arguments[8 + beam], first)
                    dot.store_levels(beam, arguments[5], builder.gep(array(7).data, [at]))
            return context.get_dummy_value()

        return signature, codegen

    return interpolate


_interpolate_one, _interpolate_two = _interpolation(1), _interpolation(2)


@njit(parallel=True, nogil=True, cache=True)
def interpolated_beams_envelope_int16(
    tiles, scales, starts, stop, offsets, weights, places, tap_weights, rows, weight_scale, n_blocks, out
):
    """`InterpolatedBeamsEnvelope` on the tiles of `QuantiseTiles`, with integer sums."""
    n_directions, n_ranges = out.shape
    n_tiles = tiles.shape[0]
    block = (n_directions + n_blocks - 1) // n_blocks
    same = same_places(places)
    for part in prange(n_tiles * n_blocks):
        tile = part // n_blocks
        begin = min(part % n_blocks * block, n_directions)
        end = min(begin + block, n_directions)
        if begin == end:
            continue
        first, last = node_span(places, begin, end)
        start = np.int64(starts[tile])
        n_used = min(RANGES, stop - start)
        pairs = new_pairs(last - first + 1)
        fill_pairs(tiles, tile, offsets, weights, first, last, n_used, pairs)
        scale = scales[tile] * weight_scale
        short = np.empty((2, RANGES), np.float32)
        direction = begin
        while direction < end:
            two = direction + 1 < end and same[direction]
            row = rows[direction] * np.int64(n_ranges) + start
            next_row = rows[min(direction + 1, end - 1)] * np.int64(n_ranges) + start
            for k in range(2, 4):
                prefetch_row(out, rows[min(direction + k, end - 1)], start, RANGES)
            if n_used < RANGES:
                if two:
                    _interpolate_two(pairs, first, places, tap_weights, direction, scale, n_used, short, 0, RANGES)
                else:
                    _interpolate_one(pairs, first, places, tap_weights, direction, scale, n_used, short, 0, 0)
                for beam in range(2 if two else 1):
                    out[rows[direction + beam], start:stop] = short[beam, :n_used]
            elif two:
                _interpolate_two(pairs, first, places, tap_weights, direction, scale, RANGES, out, row, next_row)
            else:
                _interpolate_one(pairs, first, places, tap_weights, direction, scale, RANGES, out, row, row)
            direction += 2 if two else 1
