"""Delay-and-sum and envelope in one pass, blocked for the registers and the second cache level.

Per direction and range this is ``|Σ_mic w · x|`` with complex w and x. Signals stay interleaved (re, im,
re, im …): with ``a = Σ re(w) · x`` and ``b = Σ im(w) · x`` as plain vectors of floats, the beam is
``(a_re − b_im, a_im + b_re)``, so a microphone costs two multiply-adds per vector loaded and no
shuffle; the parts are put together once, at the end. A tile of ranges holds all its sums in registers
while the microphones pass by, so that each point costs its load and nothing else.

Ranges are the outer loop: the signals of one tile (32 microphones, 10 phases, 64 ranges and the
aperture: 215 kB) stay in the second cache level while all directions of the block read them.
"""

import math

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

__all__ = ["delay_and_sum_envelope"]

_LANES = 16  # floats in a vector; LLVM splits it where registers are narrower
_VECTORS = 8  # per sum: two sums of 8 take half of the 32 registers of AVX-512
_TILE = _VECTORS * _LANES // 2  # ranges
_BLOCK = 256  # directions whose delays and weights (98 kB at 32 microphones) share the cache with a tile


@intrinsic
def _beam_tile(typing_context, signals, offsets, weights, direction, first, out):
    """Fill ``out[direction, first : first + _TILE]``; all arrays as in `DelayAndSumEnvelope`."""
    signature = types.void(signals, offsets, weights, types.intp, types.intp, out)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        direction, first = arguments[3:5]
        offsets, out = array(1), array(5)
        n_mics = cgutils.unpack_tuple(builder, offsets.shape)[1]
        n_ranges = cgutils.unpack_tuple(builder, out.shape)[1]
        number = ir.FloatType()
        vector = ir.VectorType(number, _LANES)
        lane_0 = ir.Constant(ir.IntType(32), 0)
        all_lanes_0 = ir.Constant(ir.VectorType(ir.IntType(32), _LANES), [0] * _LANES)
        blank = ir.Constant(vector, ir.Undefined)
        size = direction.type
        signal_floats = builder.bitcast(array(0).data, number.as_pointer())
        weight_floats = builder.bitcast(array(2).data, number.as_pointer())

        def splat(pointer, index):
            value = builder.insert_element(blank, builder.load(builder.gep(pointer, [index])), lane_0)
            return builder.shuffle_vector(value, blank, all_lanes_0)

        def add_product(total, x, weight):
            product = builder.fmul(x, weight, flags=("contract",))
            builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

        sums = [[cgutils.alloca_once(builder, vector) for _ in range(_VECTORS)] for _ in "ab"]
        for total in sums[0] + sums[1]:
            builder.store(ir.Constant(vector, [0.0] * _LANES), total)
        row = builder.mul(direction, n_mics)
        with cgutils.for_range(builder, n_mics) as loop:
            entry = builder.add(row, loop.index)
            offset = builder.sext(builder.load(builder.gep(offsets.data, [entry])), size)
            begin = builder.shl(builder.add(offset, first), ir.Constant(size, 1))
            even = builder.shl(entry, ir.Constant(size, 1))
            real = splat(weight_floats, even)
            imag = splat(weight_floats, builder.add(even, ir.Constant(size, 1)))
            for v in range(_VECTORS):
                place = builder.gep(signal_floats, [builder.add(begin, ir.Constant(size, v * _LANES))])
                x = builder.load(builder.bitcast(place, vector.as_pointer()))
                x.align = 4
                add_product(sums[0][v], x, real)
                add_product(sums[1][v], x, imag)

        half = ir.VectorType(number, _LANES // 2)
        indices = ir.VectorType(ir.IntType(32), _LANES // 2)
        re, im = (ir.Constant(indices, list(range(k, _LANES, 2))) for k in (0, 1))
        sqrt_name = f"llvm.sqrt.v{_LANES // 2}f32"
        sqrt = cgutils.get_or_insert_function(builder.module, ir.FunctionType(half, [half]), sqrt_name)
        target = builder.gep(out.data, [builder.add(builder.mul(direction, n_ranges), first)])
        for v in range(_VECTORS):
            a, b = builder.load(sums[0][v]), builder.load(sums[1][v])
            x = builder.fsub(builder.shuffle_vector(a, blank, re), builder.shuffle_vector(b, blank, im))
            y = builder.fadd(builder.shuffle_vector(a, blank, im), builder.shuffle_vector(b, blank, re))
            power = builder.fadd(builder.fmul(x, x), builder.fmul(y, y))
            place = builder.gep(target, [ir.Constant(size, v * _LANES // 2)])
            builder.store(builder.call(sqrt, [power]), builder.bitcast(place, half.as_pointer())).align = 4
        return context.get_dummy_value()

    return signature, codegen


@njit(nogil=True, cache=True, fastmath={"contract", "nsz"})
def _beam_short(signals, offsets, weights, direction, out):
    """One direction of an image with fewer ranges than a tile."""
    flat = signals.reshape(-1)
    for r in range(out.shape[1]):
        x, y = np.float32(0), np.float32(0)
        for mic in range(offsets.shape[1]):
            sample, weight = flat[offsets[direction, mic] + r], weights[direction, mic]
            x += sample.real * weight.real - sample.imag * weight.imag
            y += sample.real * weight.imag + sample.imag * weight.real
        out[direction, r] = np.float32(math.sqrt(x * x + y * y))


@njit(parallel=True, nogil=True, cache=True)
def delay_and_sum_envelope(signals, offsets, weights, out):
    """See `DelayAndSumEnvelope`."""
    n_directions, n_ranges = out.shape
    n_tiles = (n_ranges + _TILE - 1) // _TILE
    # Small images get smaller blocks, so that every thread has some.
    block = min(_BLOCK, max(1, n_directions // 16))
    for part in prange((n_directions + block - 1) // block):
        begin, end = part * block, min((part + 1) * block, n_directions)
        if n_ranges < _TILE:
            for direction in range(begin, end):
                _beam_short(signals, offsets, weights, direction, out)
        else:
            for tile in range(n_tiles):
                # The last tile overlaps the one before and writes the same numbers again.
                first = min(tile * _TILE, n_ranges - _TILE)
                for direction in range(begin, end):
                    _beam_tile(signals, offsets, weights, direction, first, out)
