# mypy: ignore-errors
"""Amplitudes from the sums of streams: Newton's identities and the coherence factor.

LLVM would check each plain loop for overlapping arrays, which takes four times as long as its vector types.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot16 import FLOATS, LANES, RANGES

__all__ = ["amplitudes_of"]

_VECTORS = RANGES // LANES
_SIZE, _FLOAT = ir.IntType(64), ir.FloatType()
_ZEROS = ir.Constant(FLOATS, [0.0] * LANES)


class _Rows:
    """Vectors of rows of (part, range) float32, and arithmetic with them."""

    def __init__(self, builder):
        self.builder = builder
        self._root = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(FLOATS, [FLOATS]), f"llvm.sqrt.v{LANES}f32"
        )

    def _place(self, data, row, part, vector):
        ahead = ir.Constant(row.type, part * RANGES + vector * LANES)
        index = self.builder.add(self.builder.mul(row, ir.Constant(row.type, 2 * RANGES)), ahead)
        return self.builder.bitcast(self.builder.gep(data, [index]), FLOATS.as_pointer())

    def load(self, data, row, part, vector):
        """Return a vector of ``data[row, part]``."""
        loaded = self.builder.load(self._place(data, row, part, vector))
        loaded.align = 4
        return loaded

    def store(self, value, data, row, part, vector):
        """Write a vector to ``data[row, part]``."""
        self.builder.store(value, self._place(data, row, part, vector)).align = 4

    def splat(self, number):
        """Return a number in every lane."""
        first = self.builder.insert_element(ir.Constant(FLOATS, ir.Undefined), number, ir.IntType(32)(0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return self.builder.shuffle_vector(first, ir.Constant(FLOATS, ir.Undefined), mask)

    def add_product(self, total, x, y):
        """Return ``total + x · y``, fused."""
        return self.builder.fadd(total, self.builder.fmul(x, y, flags=("contract",)), flags=("contract",))

    def power(self, x, y):
        """Return ``x² + y²``."""
        return self.add_product(self.add_product(_ZEROS, x, x), y, y)

    def root(self, value):
        """Return square roots."""
        return self.builder.call(self._root, [value])


def _newton(rows, sums, work, n_powers, k):
    """Store ``k e_k = Σ_i (−1)^(i − 1) e_(k − i) p_i``, divided by k, as row ``k − 1`` of ``work``."""
    builder, size = rows.builder, n_powers.type
    one = size(1)
    totals = [[cgutils.alloca_once(builder, FLOATS) for _ in range(_VECTORS)] for _ in (0, 1)]
    last = builder.sub(k, one)
    has_own = builder.icmp_signed("<=", k, n_powers)
    sign = _sign(builder, k)
    own_row = builder.select(has_own, last, size(0))
    own_sign = rows.splat(builder.select(has_own, sign, _FLOAT(0.0)))
    for part in (0, 1):
        for vector in range(_VECTORS):
            builder.store(builder.fmul(rows.load(sums, own_row, part, vector), own_sign), totals[part][vector])
    count = builder.select(builder.icmp_signed("<", last, n_powers), last, n_powers)
    with cgutils.for_range(builder, count) as loop:  # of i − 1
        signs = rows.splat(_sign(builder, builder.add(loop.index, one)))
        less = builder.sub(builder.sub(last, one), loop.index)
        for vector in range(_VECTORS):
            x, y = (builder.fmul(rows.load(sums, loop.index, part, vector), signs) for part in (0, 1))
            a, b = (rows.load(work, less, part, vector) for part in (0, 1))
            real, imag = (builder.load(totals[part][vector]) for part in (0, 1))
            real = rows.add_product(rows.add_product(real, a, x), builder.fneg(b), y)
            imag = rows.add_product(rows.add_product(imag, a, y), b, x)
            builder.store(real, totals[0][vector])
            builder.store(imag, totals[1][vector])
    share = rows.splat(builder.fdiv(_FLOAT(1.0), builder.sitofp(k, _FLOAT)))
    for part in (0, 1):
        for vector in range(_VECTORS):
            rows.store(builder.fmul(builder.load(totals[part][vector]), share), work, last, part, vector)


def _sign(builder, k):
    """Return ``(−1)^(k − 1)``."""
    odd = builder.trunc(k, ir.IntType(1))
    return builder.select(odd, _FLOAT(1.0), _FLOAT(-1.0))


def _coherence(rows, sums, beam, total, n_mics, least, vector):
    """Return the coherence factor; interpolation may leave slightly less power than the beam has."""
    builder = rows.builder
    coherent = rows.power(rows.load(sums, beam, 0, vector), rows.load(sums, beam, 1, vector))
    power, root = (rows.load(sums, total, part, vector) for part in (0, 1))
    bound = builder.fmul(builder.fmul(root, root), least)
    power = builder.select(builder.fcmp_ordered(">", power, bound), power, bound)
    whole = builder.fmul(power, n_mics)
    whole = builder.select(builder.fcmp_ordered(">", whole, coherent), whole, coherent)
    factor = builder.fdiv(coherent, whole)
    return builder.select(builder.fcmp_ordered(">", coherent, _ZEROS), factor, _ZEROS)


@intrinsic
def amplitudes_of(typing_context, sums, n_powers, order, beam, total, n_mics, least, work, levels, place):
    """Fill ``levels.flat[place : place + RANGES]`` from the sums of all streams, (stream, part, range).

    ``least`` is ``M / (bound · scale)`` of `CombineStreamsInt16`; ``work`` is an array of (order, part, range).
    """
    size = types.intp
    signature = types.void(sums, size, size, size, size, types.float32, types.float32, work, levels, size)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        sums, work, levels = array(0).data, array(7).data, array(8).data
        _, n_powers, order, beam, total, n_mics, least, _, _, place = arguments
        rows = _Rows(builder)
        with cgutils.for_range(builder, order) as loop:
            _newton(rows, sums, work, n_powers, builder.add(loop.index, loop.index.type(1)))
        last = builder.sub(order, order.type(1))
        target = builder.gep(levels, [place])
        weighted = builder.icmp_signed(">=", total, total.type(0))
        with builder.if_else(weighted) as (then, otherwise):
            for branch, is_weighted in ((then, True), (otherwise, False)):
                with branch:
                    count, factor = rows.splat(n_mics), rows.splat(least)
                    for vector in range(_VECTORS):
                        level = rows.root(rows.power(*(rows.load(work, last, part, vector) for part in (0, 1))))
                        if is_weighted:
                            level = builder.fmul(level, _coherence(rows, sums, beam, total, count, factor, vector))
                        at = builder.gep(target, [_SIZE(vector * LANES)])
                        builder.store(level, builder.bitcast(at, FLOATS.as_pointer())).align = 4
        return context.get_dummy_value()

    return signature, codegen
