"""Performance ceilings of this machine: kernels that measure only memory bandwidth or arithmetic throughput."""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot16 import LANES, PAIRS, SUMS, TOTALS, add_products

__all__ = ["DOT_16_OPERATIONS", "MULTIPLY_ADD_OPERATIONS", "copy", "dot_16", "multiply_add", "triad"]

_SUMS = 12  # independent sums: two units with a latency of four need at least eight
MULTIPLY_ADD_OPERATIONS = 2 * LANES * _SUMS
DOT_16_OPERATIONS = 4 * LANES * _SUMS
"""Operations of one turn on one strand; a multiply-add counts as two."""


@njit(parallel=True, nogil=True, cache=True)
def copy(source, out):
    """Read and write each number once: ``out = source``, (n,) float32."""
    for i in prange(len(out)):
        out[i] = source[i]


@njit(parallel=True, nogil=True, cache=True)
def triad(a, b, factor, out):
    """Read two numbers and write one: ``out = a + factor · b``, (n,) float32."""
    for i in prange(len(out)):
        out[i] = a[i] + factor * b[i]


@intrinsic
def _multiply_add(typing_context, turns, factor, addend):
    """Return the total of independent sums after ``turns`` steps of ``sum = sum · factor + addend``."""
    signature = types.float32(turns, factor, addend)

    def codegen(context, builder, signature, arguments):
        turns, *numbers = arguments
        vector = ir.VectorType(ir.FloatType(), LANES)
        x, y = (_splat(builder, number, vector) for number in numbers)

        def turn(total):
            product = builder.fmul(builder.load(total), x, flags=("contract",))
            builder.store(builder.fadd(product, y, flags=("contract",)), total)

        total = _run(builder, turns, vector, turn, builder.fadd)
        return builder.extract_element(total, ir.Constant(ir.IntType(32), 0))

    return signature, codegen


@intrinsic
def _dot_16(typing_context, turns, factor):
    """Return a total of independent sums of 16-bit dot products, two products per lane and turn."""
    signature = types.int32(turns, factor)

    def codegen(context, builder, signature, arguments):
        turns, factor = arguments
        pairs = builder.bitcast(_splat(builder, factor, SUMS), PAIRS)

        def turn(total):
            # Products of constants would have a sum of closed form, which LLVM uses instead of the loop.
            whole = builder.load(total)
            builder.store(add_products(builder, whole, builder.bitcast(whole, PAIRS), pairs), total)

        total = _run(builder, turns, TOTALS, turn, builder.add)
        return builder.extract_element(total, ir.Constant(ir.IntType(32), 0))

    return signature, codegen


def _splat(builder, number, vector):
    """Return a vector with a number in every lane."""
    blank, lane = ir.Constant(vector, ir.Undefined), ir.IntType(32)
    first = builder.insert_element(blank, number, ir.Constant(lane, 0))
    return builder.shuffle_vector(first, blank, ir.Constant(ir.VectorType(lane, vector.count), [0] * vector.count))


def _run(builder, turns, vector, turn, add):
    """Apply ``turn`` to each of the sums ``turns`` times, and return the sum of the sums."""
    sums = [cgutils.alloca_once(builder, vector) for _ in range(_SUMS)]
    for k, total in enumerate(sums):
        builder.store(ir.Constant(vector, [k] * vector.count), total)
    with cgutils.for_range(builder, turns):
        for total in sums:
            turn(total)
    whole = builder.load(sums[0])
    for total in sums[1:]:
        whole = add(whole, builder.load(total))
    return whole


@njit(parallel=True, nogil=True, cache=True)
def multiply_add(turns, out):
    """Run float32 multiply-adds in registers, one strand per element of ``out``, (strand,) float32."""
    for strand in prange(len(out)):
        out[strand] = _multiply_add(turns, np.float32(0.5), np.float32(1.0))


@njit(parallel=True, nogil=True, cache=True)
def dot_16(turns, out):
    """Run 16-bit dot products in registers, one strand per element of ``out``, (strand,) int32."""
    for strand in prange(len(out)):
        out[strand] = _dot_16(turns, np.int32(0x00030001))
