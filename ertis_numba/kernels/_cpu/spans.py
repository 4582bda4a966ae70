"""Explicit loops instead of NumPy functions: Numba takes seconds to compile NumPy's minimum."""

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

__all__ = ["clear", "node_span", "prefetch_row", "same_places"]

_LINE = 64  # bytes of a cache line


@njit(nogil=True, cache=True)
def node_span(places, begin, end):
    """Return the lowest and the highest beam-grid point that the directions ``begin … end`` use."""
    low, high = np.int64(places[begin, 0]), np.int64(places[begin, 0])
    for direction in range(begin, end):
        for pair in range(places.shape[1]):
            place = np.int64(places[direction, pair])
            low, high = min(low, place), max(high, place)
    return low, high + 1


@njit(nogil=True, cache=True)
def same_places(places):
    """Return True for each direction whose grid points are those of the next direction."""
    same = np.zeros(places.shape[0], np.bool_)
    for direction in range(places.shape[0] - 1):
        same[direction] = True
        for pair in range(places.shape[1]):
            if places[direction, pair] != places[direction + 1, pair]:
                same[direction] = False
    return same


@intrinsic(prefer_literal=True)
def prefetch_row(typing_context, out, row, first, count):
    """Fetch ``out[row, first : first + count]`` into the cache for writing; ``count`` is a literal."""
    # No processor predicts the rows of consecutive directions, which are kilobytes apart.
    signature = types.void(out, row, types.intp, count)
    bytes_each = count.literal_value * out.dtype.bitwidth // 8

    def codegen(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        n_columns = cgutils.unpack_tuple(builder, array.shape)[1]
        row = builder.sext(arguments[1], n_columns.type)
        octets, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        function = ir.FunctionType(ir.VoidType(), [octets, flag, flag, flag])
        prefetch = cgutils.get_or_insert_function(builder.module, function, "llvm.prefetch.p0")
        place = builder.gep(array.data, [builder.add(builder.mul(row, n_columns), arguments[2])])
        for ahead in range(0, bytes_each + 1, _LINE):
            line = builder.gep(builder.bitcast(place, octets), [ir.Constant(ir.IntType(64), ahead)])
            builder.call(prefetch, [line, flag(1), flag(3), flag(1)])  # to write, into the nearest cache, data
        return context.get_dummy_value()

    return signature, codegen


@njit(nogil=True, cache=True)
def clear(rows, begin, end):
    """Set the columns ``begin … end`` of all rows to 0."""
    for row in range(rows.shape[0]):
        for k in range(begin, end):
            rows[row, k] = 0
