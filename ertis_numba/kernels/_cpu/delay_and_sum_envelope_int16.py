"""Delay-and-sum and envelope on 16-bit samples, by the processor's 16-bit dot product.

One instruction (``vpdpwssd``) multiplies 16 complex samples, a pair of 16-bit numbers each, by a pair of
weights and adds the two products to a 32-bit sum: with the pair (re w, −im w) the real part of the
beam, with (im w, re w) its imaginary part. That is twice the points per instruction and half the bytes per
point of the float32 kernel; 2.2 times its speed on one Zen 5 core. The sums are exact integers.
"""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.features import target_features

__all__ = ["HAS_INT16_DOT", "RANGES", "delay_and_sum_envelope_int16"]

_FEATURES = target_features()
_LANES = 16 if "avx512vnni" in _FEATURES else 8  # complex samples in a vector
_VECTORS = 6  # per sum: 12 chains of additions hide the instruction's latency
_BLOCK = 512  # directions

HAS_INT16_DOT = not _FEATURES.isdisjoint({"avx512vnni", "avxvnni"})
RANGES = _VECTORS * _LANES  # of one tile


@intrinsic
def _beam_tile(typing_context, tiles, tile, offsets, weights, direction, scale, out, place):
    """Fill ``out.flat[place : place + RANGES]``; arrays as in `DelayAndSumEnvelopeInt16`."""
    signature = types.void(tiles, types.intp, offsets, weights, types.intp, types.float32, out, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        _, tile, _, _, direction, scale, _, place = arguments
        size, lane = direction.type, ir.IntType(32)
        sums_type = ir.VectorType(lane, _LANES)
        pairs_type = ir.VectorType(ir.IntType(16), 2 * _LANES)
        floats_type = ir.VectorType(ir.FloatType(), _LANES)
        all_lanes_0 = ir.Constant(ir.VectorType(lane, _LANES), [0] * _LANES)
        dot_name = f"llvm.x86.avx512.vpdpwssd.{32 * _LANES}"
        dot_type = ir.FunctionType(sums_type, [sums_type, pairs_type, pairs_type])
        dot = cgutils.get_or_insert_function(builder.module, dot_type, dot_name)
        sqrt_type = ir.FunctionType(floats_type, [floats_type])
        sqrt = cgutils.get_or_insert_function(builder.module, sqrt_type, f"llvm.sqrt.v{_LANES}f32")

        def splat(value, vector):
            blank = ir.Constant(vector, ir.Undefined)
            first = builder.insert_element(blank, value, ir.Constant(lane, 0))
            return builder.shuffle_vector(first, blank, all_lanes_0)

        shape = cgutils.unpack_tuple(builder, array(0).shape)
        n_mics, in_tile = shape[1], builder.mul(builder.mul(shape[1], shape[2]), shape[3])
        samples = builder.bitcast(array(0).data, lane.as_pointer())
        samples = builder.gep(samples, [builder.mul(tile, in_tile)])
        pairs = builder.bitcast(array(3).data, lane.as_pointer())
        offset_data = array(2).data
        sums = [[cgutils.alloca_once(builder, sums_type) for _ in range(_VECTORS)] for _ in ("re", "im")]
        for total in sums[0] + sums[1]:
            builder.store(ir.Constant(sums_type, [0] * _LANES), total)
        row = builder.mul(direction, n_mics)
        with cgutils.for_range(builder, n_mics) as loop:
            entry = builder.add(row, loop.index)
            offset = builder.sext(builder.load(builder.gep(offset_data, [entry])), size)
            even = builder.shl(entry, ir.Constant(size, 1))
            odd = builder.add(even, ir.Constant(size, 1))
            weight = [
                builder.bitcast(splat(builder.load(builder.gep(pairs, [index])), sums_type), pairs_type)
                for index in (even, odd)
            ]
            for v in range(_VECTORS):
                at = builder.gep(samples, [builder.add(offset, ir.Constant(size, v * _LANES))])
                x = builder.load(builder.bitcast(at, pairs_type.as_pointer()))
                x.align = 4
                for part in (0, 1):
                    total = sums[part][v]
                    builder.store(builder.call(dot, [builder.load(total), x, weight[part]]), total)
        scales = splat(scale, floats_type)
        target = builder.gep(array(6).data, [place])
        for v in range(_VECTORS):
            x, y = (builder.sitofp(builder.load(sums[part][v]), floats_type) for part in (0, 1))
            power = builder.fadd(builder.fmul(x, x), builder.fmul(y, y))
            level = builder.fmul(builder.call(sqrt, [power]), scales)
            at = builder.gep(target, [ir.Constant(size, v * _LANES)])
            builder.store(level, builder.bitcast(at, floats_type.as_pointer())).align = 4
        return context.get_dummy_value()

    return signature, codegen


@njit(parallel=True, nogil=True, cache=True)
def delay_and_sum_envelope_int16(tiles, scales, starts, offsets, weights, weight_scale, out):
    """See `DelayAndSumEnvelopeInt16`."""
    n_directions, n_ranges = out.shape
    block = min(_BLOCK, max(1, n_directions // 4))
    n_blocks = (n_directions + block - 1) // block
    for part in prange(tiles.shape[0] * n_blocks):
        tile = part // n_blocks
        begin = part % n_blocks * block
        scale = scales[tile] * weight_scale
        short = np.empty((1, RANGES), np.float32)
        for direction in range(begin, min(begin + block, n_directions)):
            if starts[tile] + RANGES > n_ranges:
                _beam_tile(tiles, tile, offsets, weights, direction, scale, short, 0)
                out[direction, starts[tile] :] = short[0, : n_ranges - starts[tile]]
            else:
                place = direction * n_ranges + starts[tile]
                _beam_tile(tiles, tile, offsets, weights, direction, scale, out, place)
