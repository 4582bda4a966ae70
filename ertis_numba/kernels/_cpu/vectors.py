# mypy: ignore-errors
"""CPU vectors of one register, with one lane per sample: float32, float64, or int16, which only adds.

They stay in registers also where LLVM does not vectorise a loop because its sums depend on each other.
"""

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

from ertis_numba.kernels._cpu.features import target_features

__all__ = [
    "REGISTER_BYTES",
    "Vector",
    "add_product",
    "fused",
    "ir_type",
    "load",
    "splat",
    "store",
    "subtract_product",
    "where_zero",
]

_LANE_TYPES = {types.float32: ir.FloatType(), types.float64: ir.DoubleType(), types.int16: ir.IntType(16)}
REGISTER_BYTES = 64 if "avx512f" in target_features() else 32


class Vector(types.Type):
    """Registers of float32, float64 or int16."""

    def __init__(self, dtype, n_registers):
        self.dtype, self.count = dtype, 8 * n_registers * REGISTER_BYTES // dtype.bitwidth
        super().__init__(name=f"Vector({dtype}, {self.count})")


def ir_type(vector):
    """Return the LLVM type of a `Vector`."""
    return ir.VectorType(_LANE_TYPES[vector.dtype], vector.count)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, vector):
        super().__init__(manager, vector, ir_type(vector))


def _add_operator(function, instruction):
    """Register ``function`` for two vectors in compiled code."""

    @intrinsic
    def apply(typing_context, a, b):
        def codegen(context, builder, signature, arguments):
            return getattr(builder, "add" if a.dtype == types.int16 else instruction)(*arguments)

        return a(a, b), codegen

    @overload(function)
    def choose(a, b):
        if isinstance(a, Vector) and a == b and (a.dtype != types.int16 or function is operator.add):
            return lambda a, b: apply(a, b)  # noqa: PLW0108 - Numba compiles only Python functions
        return None


for _function, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _add_operator(_function, _instruction)


def fused(builder, a, b, c):
    """Return ``a · b + c``, rounded once if the processor can."""
    name = f"llvm.fmuladd.v{a.type.count}f{32 if a.type.element == ir.FloatType() else 64}"
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(a.type, [a.type] * 3), name)
    return builder.call(function, [a, b, c])


@intrinsic
def add_product(typing_context, total, a, b):
    """Return ``total + a · b``."""

    def codegen(context, builder, signature, arguments):
        total, a, b = arguments
        return fused(builder, a, b, total)

    return total(total, a, b), codegen


@intrinsic
def subtract_product(typing_context, total, a, b):
    """Return ``total − a · b``."""

    def codegen(context, builder, signature, arguments):
        total, a, b = arguments
        return fused(builder, builder.fneg(a), b, total)

    return total(total, a, b), codegen


@intrinsic
def where_zero(typing_context, value, other):
    """Return ``value``, with the lanes that are 0 replaced by those of ``other``."""

    def codegen(context, builder, signature, arguments):
        value, other = arguments
        is_zero = builder.fcmp_ordered("==", value, ir.Constant(value.type, [0.0] * value.type.count))
        return builder.select(is_zero, other, value)

    return value(value, other), codegen


@intrinsic(prefer_literal=True)
def splat(typing_context, array, number, n_registers):
    """Return a number in all lanes of a vector of the array's type."""
    vector = Vector(array.dtype, n_registers.literal_value)

    def codegen(context, builder, signature, arguments):
        kind = ir_type(vector)
        value = context.cast(builder, arguments[1], signature.args[1], array.dtype)
        first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), vector.count), [0] * vector.count)
        return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), zeros)

    return vector(array, number, n_registers), codegen


@intrinsic(prefer_literal=True)
def load(typing_context, array, index, n_registers):
    """Return a vector of the numbers from ``array.flat[index]`` on; the array is C-contiguous."""
    vector = Vector(array.dtype, n_registers.literal_value)

    def codegen(context, builder, signature, arguments):
        loaded = builder.load(_place(context, builder, vector, signature.args[0], *arguments[:2]))
        loaded.align = array.dtype.bitwidth // 8
        return loaded

    return vector(array, types.intp, n_registers), codegen


@intrinsic
def store(typing_context, vector, array, index):
    """Set the numbers from ``array.flat[index]`` on to a vector; the array is C-contiguous."""

    def codegen(context, builder, signature, arguments):
        value, *place = arguments
        stored = builder.store(value, _place(context, builder, *signature.args[:2], *place))
        stored.align = array.dtype.bitwidth // 8
        return context.get_dummy_value()

    return types.void(vector, array, types.intp), codegen


def _place(context, builder, vector, array_type, array, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), ir_type(vector).as_pointer())
