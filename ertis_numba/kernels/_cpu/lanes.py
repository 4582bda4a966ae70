"""CPU vectors for kernels that are recursive in time, with one lane per microphone.

A `Lanes` stays in registers. Nothing is contracted or reordered, so all processors yield the same bits.
"""

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

from ertis_numba.kernels._cpu.features import target_features

__all__ = ["LANES", "as_float64", "bits", "clamp", "load", "sign", "splat", "store", "transposed", "turn_octet"]

LANES = 16 if "avx512f" in target_features() else 8
"""Microphones processed in parallel: two vectors of AVX-512 or of AVX, because one would stall at every step."""

_INT32 = ir.IntType(32)


class Lanes(types.Type):
    """`LANES` numbers of one type, float64 or uint64."""

    def __init__(self, dtype):
        self.dtype = dtype
        super().__init__(name=f"Lanes({dtype}, {LANES})")


_FLOAT64, _UINT64 = Lanes(types.float64), Lanes(types.uint64)


def _vector(dtype, count=LANES):
    return ir.VectorType(ir.DoubleType() if dtype == types.float64 else ir.IntType(64), count)


def _constant(number):
    return ir.Constant(_vector(types.float64), [number] * LANES)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, lanes):
        super().__init__(manager, lanes, _vector(lanes.dtype))


def _add_operator(function, dtype, instruction):
    """Register ``function`` for two `Lanes` in compiled code."""

    @intrinsic
    def apply(typing_context, a, b):
        def codegen(context, builder, signature, arguments):
            return getattr(builder, instruction)(*arguments)

        return a(a, b), codegen

    @overload(function)
    def choose(a, b):
        if isinstance(a, Lanes) and a.dtype == dtype and a == b:
            return lambda a, b: apply(a, b)  # noqa: PLW0108 - Numba compiles only Python functions
        return None


for _function, _dtype, _instruction in (
    (operator.add, types.float64, "fadd"),
    (operator.sub, types.float64, "fsub"),
    (operator.mul, types.float64, "fmul"),
    (operator.add, types.uint64, "add"),
    (operator.mul, types.uint64, "mul"),
    (operator.xor, types.uint64, "xor"),
    (operator.and_, types.uint64, "and_"),
    (operator.or_, types.uint64, "or_"),
    (operator.rshift, types.uint64, "lshr"),
):
    _add_operator(_function, _dtype, _instruction)


@intrinsic
def splat(typing_context, number):
    """Return a number in all lanes."""
    lanes = _FLOAT64 if number == types.float64 else _UINT64

    def codegen(context, builder, signature, arguments):
        blank = ir.Constant(_vector(lanes.dtype), ir.Undefined)
        first = builder.insert_element(blank, arguments[0], _INT32(0))
        return builder.shuffle_vector(first, blank, ir.Constant(ir.VectorType(_INT32, LANES), [0] * LANES))

    return lanes(number), codegen


@intrinsic
def as_float64(typing_context, lanes):
    """Return the same 64 bits, read as float64."""

    def codegen(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], _vector(types.float64))

    return _FLOAT64(lanes), codegen


def _not_negative(builder, value):
    return builder.fcmp_ordered(">=", value, _constant(0.0))


@intrinsic
def bits(typing_context, lanes):
    """Return an integer of `LANES` bits, 1 for lanes that are at least 0; lane 0 is the lowest bit."""

    def codegen(context, builder, signature, arguments):
        return builder.bitcast(_not_negative(builder, arguments[0]), ir.IntType(LANES))

    return types.Integer.from_bitwidth(LANES, signed=False)(lanes), codegen


@intrinsic
def sign(typing_context, lanes):
    """Return +1 in lanes that are at least 0, else −1."""

    def codegen(context, builder, signature, arguments):
        return builder.select(_not_negative(builder, arguments[0]), _constant(1.0), _constant(-1.0))

    return lanes(lanes), codegen


@intrinsic
def clamp(typing_context, lanes, low, high):
    """Return ``min(max(lanes, low), high)``."""

    def codegen(context, builder, signature, arguments):
        lanes, low, high = arguments
        lanes = builder.select(builder.fcmp_ordered(">", lanes, low), lanes, low)
        return builder.select(builder.fcmp_ordered("<", lanes, high), lanes, high)

    return lanes(lanes, low, high), codegen


def _row_pointer(context, builder, array_type, array, row):
    data = context.make_array(array_type)(context, builder, array).data
    place = builder.gep(data, [builder.mul(row, row.type(LANES))])
    return builder.bitcast(place, _vector(array_type.dtype).as_pointer())


@intrinsic
def load(typing_context, array, row):
    """Return row ``row`` of an array of (n, LANES) float64 or uint64, C-contiguous."""

    def codegen(context, builder, signature, arguments):
        return _load(builder, _row_pointer(context, builder, signature.args[0], *arguments))

    return Lanes(array.dtype)(array, types.intp), codegen


@intrinsic
def store(typing_context, lanes, array, row):
    """Set row ``row`` of an array of (n, LANES) float64, C-contiguous."""

    def codegen(context, builder, signature, arguments):
        value, *place = arguments
        builder.store(value, _row_pointer(context, builder, signature.args[1], *place)).align = 8
        return context.get_dummy_value()

    return types.void(lanes, array, types.intp), codegen


@intrinsic
def turn_octet(typing_context, signals, rows, octet, sample, tile, n):
    """Copy 8 samples of 8 signals: ``tile[n + j, 8 · octet + i] = signals[rows[8 · octet + i], sample + j]``."""
    # Three rounds of exchanges between pairs of vectors transpose the samples: eight gathered numbers are eight loads.
    signature = types.void(signals, rows, types.intp, types.intp, tile, types.intp)

    def codegen(context, builder, signature, arguments):
        values = dict(zip(("signals", "rows", "octet", "sample", "tile", "n"), arguments, strict=True))
        signals, rows, tile = (context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (0, 1, 4))
        length = cgutils.unpack_tuple(builder, signals.shape)[1]
        vector, whole = _vector(types.float64, 8).as_pointer(), values["n"].type
        lane = builder.mul(values["octet"], whole(8))
        octet = []
        for i in range(8):
            row = builder.load(builder.gep(rows.data, [builder.add(lane, whole(i))]))
            place = builder.add(builder.mul(row, length), values["sample"])
            octet.append(_load(builder, builder.bitcast(builder.gep(signals.data, [place]), vector)))
        for j, turned in enumerate(transposed(builder, octet)):
            row = builder.add(values["n"], whole(j))
            place = builder.add(builder.mul(row, whole(LANES)), lane)
            builder.store(turned, builder.bitcast(builder.gep(tile.data, [place]), vector)).align = 8
        return context.get_dummy_value()

    return signature, codegen


def transposed(builder, rows):
    """Return n vectors of n numbers, transposed; n is a power of 2."""
    n, index = len(rows), ir.IntType(32)
    step = 1
    while step < n:
        even = [k ^ step | n if k & step else k for k in range(n)]  # indices of n and above select the second vector
        odd = [k | n if k & step else k ^ step for k in range(n)]
        rows = [
            builder.shuffle_vector(
                rows[i & ~step], rows[i | step], ir.Constant(ir.VectorType(index, n), odd if i & step else even)
            )
            for i in range(n)
        ]
        step *= 2
    return rows


def _load(builder, pointer):
    vector = builder.load(pointer)
    vector.align = 8  # NumPy guarantees no more
    return vector
