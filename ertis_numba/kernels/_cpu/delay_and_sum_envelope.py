"""Delay-and-sum and envelope in one pass, blocked for the registers and the L2 cache.

A tile keeps all its sums in registers over the microphones. Its signals, 215 kB, stay in the L2 cache for all
directions of a block.
"""

import numpy as np
from numba import njit, prange, types
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot32 import TILE, Dot32
from ertis_numba.kernels._scalar import magnitude

__all__ = ["delay_and_sum_envelope"]

_BLOCK = 256  # directions whose delays and weights (98 kB at 32 microphones) share the cache with a tile


@intrinsic
def _beam_tile(typing_context, signals, offsets, weights, direction, first, out, place):
    """Fill ``out.flat[place : place + TILE]`` with ranges starting at ``first``; arrays as in `DelayAndSumEnvelope`."""
    signature = types.void(signals, offsets, weights, types.intp, types.intp, out, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        direction, first = arguments[3:5]
        dot = Dot32(builder)
        with dot.passes(first.type) as ahead:
            dot.add_complex_terms(array(0), array(1), array(2), direction, builder.add(first, ahead))
            dot.store_levels(builder.gep(array(5).data, [builder.add(arguments[6], ahead)]))
        return context.get_dummy_value()

    return signature, codegen


@njit(nogil=True, cache=True, fastmath={"contract"})
def _beam_short(signals, offsets, weights, direction, first, stop, out):
    """Fill one direction of an image with fewer ranges than a tile."""
    flat = signals.reshape(-1)
    for r in range(first, stop):
        x, y = np.float32(0), np.float32(0)
        for term in range(offsets.shape[1]):
            sample, weight = flat[offsets[direction, term] + r], weights[direction, term]
            x = (x + sample.real * weight.real) - sample.imag * weight.imag
            y = (y + sample.real * weight.imag) + sample.imag * weight.real
        out[direction, r] = np.float32(magnitude(x, y))


@njit(parallel=True, nogil=True, cache=True)
def delay_and_sum_envelope(signals, offsets, weights, first, stop, out):
    """`DelayAndSum` and `Envelope` in one pass over some ranges, without writing beams to memory."""
    n_directions = out.shape[0]
    n_tiles = (stop - first + TILE - 1) // TILE
    # Small images get smaller blocks, so that every thread gets some.
    block = min(_BLOCK, max(1, n_directions // 16))
    for part in prange((n_directions + block - 1) // block):
        begin, end = part * block, min((part + 1) * block, n_directions)
        if out.shape[1] < TILE:
            for direction in range(begin, end):
                _beam_short(signals, offsets, weights, direction, first, stop, out)
        elif stop - first < TILE:
            at = max(0, stop - TILE)
            short = np.empty((1, TILE), np.float32)
            for direction in range(begin, end):
                _beam_tile(signals, offsets, weights, direction, at, short, 0)
                out[direction, first:stop] = short[0, first - at : stop - at]
        else:
            for tile in range(n_tiles):
                # The last tile overlaps the previous one and writes the same numbers again.
                at = min(first + tile * TILE, stop - TILE)
                for direction in range(begin, end):
                    _beam_tile(signals, offsets, weights, direction, at, out, direction * out.shape[1] + at)
