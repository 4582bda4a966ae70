"""Delay-and-sum and envelope on 16-bit samples.

An instruction handles twice the points of float32, and the sums are exact: 2.2 times as fast on a Zen 5 core.
"""

import numpy as np
from numba import njit, prange, types
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot16 import RANGES, Dot16

__all__ = ["delay_and_sum_envelope_int16"]

_BLOCK = 512  # directions


@intrinsic
def _beam_tile(typing_context, tiles, tile, offsets, weights, direction, scale, out, place, n_used):
    """Fill ``out.flat[place : place + n_used]`` or more, up to `RANGES`; arrays as in `DelayAndSumEnvelopeInt16`."""
    signature = types.void(tiles, types.intp, offsets, weights, types.intp, types.float32, out, types.intp, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        dot = Dot16(builder)
        with dot.passes(arguments[8]) as first:
            dot.add_complex_terms(array(0), arguments[1], array(2), array(3), arguments[4], first)
            dot.store_levels(0, arguments[5], builder.gep(array(6).data, [builder.add(arguments[7], first)]))
        return context.get_dummy_value()

    return signature, codegen


@njit(parallel=True, nogil=True, cache=True)
def delay_and_sum_envelope_int16(tiles, scales, starts, stop, offsets, weights, weight_scale, out):
    """`DelayAndSumEnvelope` on the tiles of `QuantiseTiles`, with integer sums."""
    n_directions, n_ranges = out.shape
    block = min(_BLOCK, max(1, n_directions // 4))
    n_blocks = (n_directions + block - 1) // block
    for part in prange(tiles.shape[0] * n_blocks):
        tile = part // n_blocks
        begin = part % n_blocks * block
        scale = scales[tile] * weight_scale
        short = np.empty((1, RANGES), np.float32)
        for direction in range(begin, min(begin + block, n_directions)):
            if starts[tile] + RANGES > stop:
                _beam_tile(tiles, tile, offsets, weights, direction, scale, short, 0, stop - starts[tile])
                out[direction, starts[tile] : stop] = short[0, : stop - starts[tile]]
            else:
                place = direction * n_ranges + starts[tile]
                _beam_tile(tiles, tile, offsets, weights, direction, scale, out, place, RANGES)
