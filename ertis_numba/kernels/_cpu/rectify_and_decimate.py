# mypy: ignore-errors
"""Rectify real beams, filter them, and keep every factor-th sample, with 16-bit products."""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot16 import FLOAT, LANES, PAIRS, TOTALS, add_products

__all__ = ["rectify_and_decimate"]

_SPAN = 2048  # samples that are rectified at a time, and share a unit
_TOGETHER = 4  # ranges for which each tap is read once
_WIDTH = 2 * LANES  # numbers in a vector
_MAX = 32_766  # one less than the largest, because of rounding
_SMALLEST = 1e-30


@intrinsic
def _filter_together(typing_context, magnitude, start, factor, taps, sums):
    """Set ``sums[k]`` to ``Σ_t taps[t] · magnitude[start + k · factor + t]`` for four k; taps fill whole vectors."""
    signature = types.void(magnitude, types.intp, types.intp, taps, sums)

    def codegen(context, builder, signature, arguments):
        samples, weights, target = (
            context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (0, 3, 4)
        )
        size = arguments[1].type
        totals = [cgutils.alloca_once(builder, TOTALS) for _ in range(_TOGETHER)]
        for total in totals:
            builder.store(ir.Constant(TOTALS, [0] * TOTALS.count), total)

        def vector(data, index):
            loaded = builder.load(builder.bitcast(builder.gep(data, [index]), PAIRS.as_pointer()))
            loaded.align = 2
            return loaded

        n_taps = builder.extract_value(weights.shape, 0)
        with cgutils.for_range(builder, builder.sdiv(n_taps, ir.Constant(size, _WIDTH))) as loop:
            tap = builder.mul(loop.index, ir.Constant(size, _WIDTH))
            weight = vector(weights.data, tap)
            place = builder.add(arguments[1], tap)
            for total in totals:
                builder.store(add_products(builder, builder.load(total), vector(samples.data, place), weight), total)
                place = builder.add(place, arguments[2])
        # The lanes of a sum may exceed 32 bits together.
        floats = ir.VectorType(FLOAT, TOTALS.count)
        add_lanes = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(FLOAT, [FLOAT, floats]), f"llvm.vector.reduce.fadd.v{TOTALS.count}f32"
        )
        for k, total in enumerate(totals):
            lanes = builder.sitofp(builder.load(total), floats)
            added = builder.call(add_lanes, [ir.Constant(FLOAT, 0.0), lanes], fastmath=["reassoc"])
            builder.store(added, builder.gep(target.data, [ir.Constant(size, k)]))
        return context.get_dummy_value()

    return signature, codegen


@njit(nogil=True, cache=True)
def _round_magnitudes(row, out):
    """Fill ``out`` with magnitudes of at most 15 bits, and return their unit."""
    # The bits of positive numbers have the same order as the numbers.
    bits = row.view(np.uint32)
    largest = np.zeros(1, np.uint32)
    for n in range(row.size):
        magnitude = bits[n] & np.uint32(0x7FFFFFFF)
        largest[0] = max(largest[0], magnitude)
    unit = max(largest.view(np.float32)[0] / np.float32(_MAX), np.float32(_SMALLEST))
    inverse, half = np.float32(1) / unit, np.float32(0.5)
    for n in range(row.size):
        out[n] = np.int16(abs(row[n]) * inverse + half)
    return unit


@njit(parallel=True, nogil=True, cache=True)
def rectify_and_decimate(beams, taps, scale, factor, first, out):
    """Rectify real beams, filter them, and keep every factor-th sample."""
    n_ranges = out.shape[1]
    padded_taps = np.zeros((taps.size + _WIDTH - 1) // _WIDTH * _WIDTH, np.int16)
    padded_taps[: taps.size] = taps
    per_span = max(_TOGETHER, (_SPAN - taps.size) // factor + 1)
    for direction in prange(out.shape[0]):
        # The last ranges of a span read on, and their sums are not used, or have taps of 0 there.
        magnitude = np.zeros((per_span + _TOGETHER) * factor + padded_taps.size, np.int16)
        sums = np.empty(_TOGETHER, np.float32)
        for begin in range(0, n_ranges, per_span):
            count = min(per_span, n_ranges - begin)
            start = first + begin * factor
            source = beams[direction, start : start + (count - 1) * factor + taps.size]
            unit = _round_magnitudes(source, magnitude) * np.float32(scale)
            for r in range(0, count, _TOGETHER):
                _filter_together(magnitude, r * factor, factor, padded_taps, sums)
                for k in range(min(_TOGETHER, count - r)):
                    out[direction, begin + r + k] = sums[k] * unit
