"""Beams on a coarse grid by delay-and-sum, interpolated to all directions, on 16-bit samples.

Both steps multiply pairs of 16-bit numbers. In the second step, a pair consists of two neighbouring grid points at one
range. An instruction therefore adds two grid points at once, and loads never cross a cache line. The grid beams of a
tile stay in the L2 cache between the steps.
"""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot16 import INT32, LANES, RANGES, SHORTS, SUMS, Dot16
from ertis_numba.kernels._cpu.spans import node_span, prefetch_row, same_places

__all__ = ["interpolated_beams_envelope_int16"]

_LINE = 64  # bytes of a cache line


@intrinsic
def _address(typing_context, array):
    """Return the address of an array's data; ``array.ctypes.data`` would exclude callers from Numba's cache."""
    signature = types.intp(array)

    def codegen(context, builder, signature, arguments):
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.ptrtoint(data, context.get_value_type(types.intp))

    return signature, codegen


@intrinsic
def _node_tile(typing_context, tiles, tile, offsets, weights, node, n_used, rows, row):
    """Fill ``n_used`` ranges or more of ``rows[row]``, (part, range) int16, with a beam of a grid point.

    The beam is that of the contract: the rounded upper 16 bits of its sums.
    """
    signature = types.void(tiles, types.intp, offsets, weights, types.intp, types.intp, rows, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        dot, row = Dot16(builder), arguments[7]
        begin = builder.mul(row, ir.Constant(row.type, 2 * RANGES))
        with dot.passes(arguments[5]) as first:
            dot.add_complex_terms(array(0), arguments[1], array(2), array(3), arguments[4], first)
            dot.store_upper_halves(builder.gep(array(6).data, [builder.add(begin, first)]))
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def _pair_rows(typing_context, rows, lower, pairs, node):
    """Fill ``pairs[node]`` with row ``lower`` in the low bits and the other row in the high bits.

    The code uses LLVM's vector types, because LLVM does not vectorise such a loop.
    """
    signature = types.void(rows, types.intp, pairs, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        size = arguments[1].type
        low = builder.mul(arguments[1], ir.Constant(size, 2 * RANGES))
        high = builder.sub(ir.Constant(size, 2 * RANGES), low)
        begin = builder.mul(arguments[3], ir.Constant(size, 2 * RANGES))
        for ahead in range(0, 2 * RANGES, LANES):
            step = ir.Constant(size, ahead)
            parts = []
            for row in (low, high):
                place = builder.gep(array(0).data, [builder.add(row, step)])
                loaded = builder.load(builder.bitcast(place, SHORTS.as_pointer()))
                loaded.align = 2
                parts.append(builder.zext(loaded, SUMS))
            both = builder.or_(parts[0], builder.shl(parts[1], ir.Constant(SUMS, [16] * LANES)))
            place = builder.gep(array(2).data, [builder.add(begin, step)])
            builder.store(both, builder.bitcast(place, SUMS.as_pointer())).align = 4 * LANES
        return context.get_dummy_value()

    return signature, codegen


def _interpolation(n_beams):
    """Return an intrinsic that interpolates one direction, or two that share their grid points."""

    @intrinsic
    def interpolate(typing_context, pairs, skipped, places, weights, direction, scale, n_used, out, place, next_place):
        """Fill ``out.flat[place : place + n_used]`` or more, up to `RANGES`; a second direction has ``next_place …``.

        ``pairs`` is (point, part, range) int32, and its first point is ``skipped``. Each number holds a grid point in
        its low 16 bits and the next one in its high 16 bits.
        """
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


@njit(nogil=True, cache=True)
def _node_pairs(tiles, tile, offsets, weights, first, last, n_used):
    """Return pairs of beams of the grid points ``first … last``: (point, part, range) int32, aligned to cache lines."""
    raw = np.empty((last - first + 1) * 2 * RANGES + _LINE // 4, np.int32)
    ahead = (-_address(raw) % _LINE) // 4
    pairs = raw[ahead : ahead + (last - first + 1) * 2 * RANGES].reshape(last - first + 1, 2, RANGES)
    both = np.empty((2, 2 * RANGES), np.int16)
    for node in range(first, last + 1):
        _node_tile(tiles, tile, offsets, weights, node, n_used, both, node % 2)
        if node > first:
            _pair_rows(both, 1 - node % 2, pairs, node - 1 - first)
    return pairs


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
        pairs = _node_pairs(tiles, tile, offsets, weights, first, last, n_used)
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
