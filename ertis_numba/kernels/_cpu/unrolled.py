# mypy: ignore-errors
"""Equations of Capon for a fixed number of snapshots, as code without loops."""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.vectors import Vector, fused, ir_type

__all__ = ["solve_unrolled"]


class _Window:
    """Emits the instructions for one vector of windows; complex numbers are pairs of vectors."""

    def __init__(self, builder, kind, width, first):
        self._builder, self.kind, self._width, self._first = builder, kind, width, first

    def constant(self, number):
        return ir.Constant(self.kind, [number] * self.kind.count)

    def place(self, pointer, index):
        return self._builder.bitcast(self._builder.gep(pointer, [index]), self.kind.as_pointer())

    def load(self, pointer, row, planes=0):
        """Return the numbers of a row of the window, some planes of ``width`` further."""
        builder, whole = self._builder, self._width.type
        index = builder.add(builder.add(self._first, whole(row)), builder.mul(self._width, whole(planes)))
        loaded = builder.load(self.place(pointer, index))
        loaded.align = 4 if self.kind.element == ir.FloatType() else 8
        return loaded

    def load_pair(self, pointer, row, planes=0):
        return self.load(pointer, row, planes), self.load(pointer, row, planes + 1)

    def conjugate(self, a):
        return a[0], self._builder.fneg(a[1])

    def scaled(self, a, factor):
        return tuple(self._builder.fmul(part, factor) for part in a)

    def minus_product(self, total, a, b):
        """Return ``total − a · conj(b)``."""
        builder, (a_real, a_imag), (b_real, b_imag) = self._builder, a, b
        negative = builder.fneg(a_real), builder.fneg(a_imag)
        real = fused(builder, negative[1], b_imag, fused(builder, negative[0], b_real, total[0]))
        return real, fused(builder, a_real, b_imag, fused(builder, negative[1], b_real, total[1]))

    def minus_square(self, total, a, b):
        """Return the real part of ``total − a · conj(b)``, for a product that is real."""
        builder = self._builder
        total = fused(builder, builder.fneg(a[0]), b[0], total)
        return fused(builder, builder.fneg(a[1]), b[1], total)


def _emit(builder, window, pointers, loading, n_snapshots):
    """Return the solution at the middle of the window; the method is that of `combine_capon._solve`."""
    beams, power, lags = pointers
    middle = n_snapshots // 2
    order = [*(k for k in range(n_snapshots) if k != middle), middle]
    epsilon = window.load(power, 0)
    for k in range(1, n_snapshots):
        epsilon = builder.fadd(epsilon, window.load(power, k))
    epsilon = builder.fmul(epsilon, loading)
    silent = builder.fcmp_ordered("==", epsilon, window.constant(0.0))
    epsilon = builder.select(silent, window.constant(1.0), epsilon)
    below, factors = {}, {}
    for j, p in enumerate(order):
        pivot = window.load(lags, p)
        for k in range(j):
            pivot = window.minus_square(pivot, below[j, k], factors[j, k])
        inverse = builder.fdiv(window.constant(1.0), builder.fadd(pivot, epsilon))
        for i in range(j + 1, n_snapshots + 1):
            if i == n_snapshots:  # the row below the matrix is that of the beams
                entry = window.conjugate(window.load_pair(beams, p))
            else:
                q = order[i]
                entry = window.load_pair(lags, min(p, q), 2 * abs(q - p))
                entry = window.conjugate(entry) if q < p else entry
            for k in range(j):
                entry = window.minus_product(entry, below[i, k], factors[j, k])
            below[i, j], factors[i, j] = entry, window.scaled(entry, inverse)
    return window.scaled(factors[n_snapshots, n_snapshots - 1], epsilon)


@intrinsic(prefer_literal=True)
def solve_unrolled(typing_context, beams, power, lags, width, first, loading, levels, row, n_snapshots):
    """Set the levels at the middle of the windows from ``first`` on, one window per lane."""
    vector, count = Vector(lags.dtype, 1), n_snapshots.literal_value

    def codegen(context, builder, signature, arguments):
        beams, power, lags, levels = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 1, 2, 6)
        )
        width, first, row = (arguments[k] for k in (3, 4, 7))
        window = _Window(builder, ir_type(vector), width, first)
        blank = ir.Constant(window.kind, ir.Undefined)
        lane = builder.insert_element(blank, arguments[5], ir.Constant(ir.IntType(32), 0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), vector.count), [0] * vector.count)
        loading = builder.shuffle_vector(lane, blank, zeros)
        solved = _emit(builder, window, (beams, power, lags), loading, count)
        for part, value in enumerate(solved):
            index = builder.add(row, builder.mul(width, width.type(part)))
            builder.store(value, window.place(levels, index)).align = vector.dtype.bitwidth // 8
        return context.get_dummy_value()

    whole = types.intp
    return types.void(beams, power, lags, whole, whole, lags.dtype, levels, whole, n_snapshots), codegen
