# mypy: ignore-errors
"""Sum the delayed 16-bit signals of all microphones. This takes half of the time that float32 takes."""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.vectors import REGISTER_BYTES, load

__all__ = ["sum_delayed_int16"]

_REGISTERS = 4
_WIDTH = _REGISTERS * REGISTER_BYTES // 2  # samples that are summed at a time
_DIRECTIONS = 32  # directions per block


@intrinsic
def _store_scaled(typing_context, total, unit, array, index):
    """Set the float32 numbers from ``array.flat[index]`` on to ``unit`` times an int16 vector."""

    def codegen(context, builder, signature, arguments):
        total, unit, array, index = arguments
        kind = ir.VectorType(ir.FloatType(), total.type.count)
        blank = ir.Constant(kind, ir.Undefined)
        first = builder.insert_element(blank, unit, ir.Constant(ir.IntType(32), 0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), kind.count), [0] * kind.count)
        scaled = builder.fmul(builder.sitofp(total, kind), builder.shuffle_vector(first, blank, zeros))
        data = context.make_array(signature.args[2])(context, builder, array).data
        builder.store(scaled, builder.bitcast(builder.gep(data, [index]), kind.as_pointer())).align = 4
        return context.get_dummy_value()

    return types.void(total, types.float32, array, types.intp), codegen


@njit(parallel=True, nogil=True, cache=True)
def sum_delayed_int16(tiles, units, delays, out):
    """Sum the delayed 16-bit signals of all microphones for every direction and sample."""
    n_tiles, n_mics, stride = tiles.shape
    n_directions, n_samples = out.shape
    in_tile = n_samples // n_tiles
    whole = in_tile // _WIDTH * _WIDTH
    for block in prange((n_directions + _DIRECTIONS - 1) // _DIRECTIONS):
        starts = np.empty(n_mics, np.int64)
        # All directions of a block use one tile, which the cache holds, before the next.
        for tile in range(n_tiles):
            for direction in range(block * _DIRECTIONS, min((block + 1) * _DIRECTIONS, n_directions)):
                for mic in range(n_mics):
                    starts[mic] = (tile * n_mics + mic) * stride + delays[direction, mic]
                row = direction * n_samples + tile * in_tile
                for begin in range(0, whole, _WIDTH):
                    total = load(tiles, starts[0] + begin, _REGISTERS)
                    for mic in range(1, n_mics):
                        total = total + load(tiles, starts[mic] + begin, _REGISTERS)
                    _store_scaled(total, units[tile], out, row + begin)
                for n in range(whole, in_tile):
                    rest = 0
                    for mic in range(n_mics):
                        rest += tiles.flat[starts[mic] + n]
                    out.flat[row + n] = np.float32(rest) * units[tile]
