# mypy: ignore-errors
"""Beams at beam-grid points in 16 bits, stored as pairs of neighbours for the CPU's 16-bit dot product."""

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot16 import LANES, RANGES, SHORTS, SUMS, Dot16

__all__ = ["fill_pairs", "new_pairs"]

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
    """Fill ``n_used`` ranges or more of ``rows[row]``, (part, range), with a point's rounded upper 16 bits of sums."""
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
    """Fill ``pairs[node]`` with two rows, ``lower`` in the low bits, by LLVM's vector types, as loops give none."""
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


@njit(nogil=True, cache=True)
def new_pairs(count):
    """Return an uninitialised array for pairs, (count, part, range) int32, aligned to cache lines."""
    raw = np.empty(count * 2 * RANGES + _LINE // 4, np.int32)
    ahead = (-_address(raw) % _LINE) // 4
    return raw[ahead : ahead + count * 2 * RANGES].reshape(count, 2, RANGES)


@njit(nogil=True, cache=True)
def fill_pairs(tiles, tile, offsets, weights, first, last, n_used, pairs):
    """Fill ``pairs``, (point, part, range), with beams of points ``first … last``, the next ones in the high bits."""
    both = np.empty((2, 2 * RANGES), np.int16)
    for node in range(first, last + 1):
        _node_tile(tiles, tile, offsets, weights, node, n_used, both, node % 2)
        if node > first:
            _pair_rows(both, 1 - node % 2, pairs, node - 1 - first)
