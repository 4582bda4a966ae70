# What Numba compiles has no annotations.
# mypy: ignore-errors
"""What this machine can do at most: memory bandwidth and arithmetic, measured by kernels that do nothing else.

Only benchmarks use these; they are no part of the signal chain.
"""

import numpy as np
from llvmlite import binding, ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

__all__ = ["FLOPS_PER_TURN", "copy", "multiply_add", "triad"]

_LANES = 16 if binding.get_host_cpu_features().get("avx512f", False) else 8
_SUMS = 12  # independent sums: two units with a latency of four want at least eight
FLOPS_PER_TURN = 2 * _LANES * _SUMS
"""Floating-point operations of one turn of `multiply_add` on one thread."""


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
    """Return the total of independent sums, each ``sum · factor + addend`` for so many turns."""
    signature = types.float32(turns, factor, addend)

    def codegen(context, builder, signature, arguments):
        turns, factor, addend = arguments
        vector = ir.VectorType(ir.FloatType(), _LANES)
        blank = ir.Constant(vector, ir.Undefined)
        lane_0 = ir.Constant(ir.IntType(32), 0)
        all_lanes_0 = ir.Constant(ir.VectorType(ir.IntType(32), _LANES), [0] * _LANES)

        def splat(value):
            return builder.shuffle_vector(builder.insert_element(blank, value, lane_0), blank, all_lanes_0)

        x, y = splat(factor), splat(addend)
        sums = [cgutils.alloca_once(builder, vector) for _ in range(_SUMS)]
        for k, total in enumerate(sums):
            builder.store(ir.Constant(vector, [float(k)] * _LANES), total)
        with cgutils.for_range(builder, turns):
            for total in sums:
                product = builder.fmul(builder.load(total), x, flags=("contract",))
                builder.store(builder.fadd(product, y, flags=("contract",)), total)
        whole = builder.load(sums[0])
        for total in sums[1:]:
            whole = builder.fadd(whole, builder.load(total))
        lanes = [builder.extract_element(whole, ir.Constant(ir.IntType(32), k)) for k in range(_LANES)]
        result = lanes[0]
        for lane in lanes[1:]:
            result = builder.fadd(result, lane)
        return result

    return signature, codegen


@njit(parallel=True, nogil=True, cache=True)
def multiply_add(turns, out):
    """Run float32 multiply-adds in registers, one strand per element of ``out``, (strand,) float32."""
    for strand in prange(len(out)):
        out[strand] = _multiply_add(turns, np.float32(0.5), np.float32(1.0))
