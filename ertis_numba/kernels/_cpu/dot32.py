"""Vectorised sums of complex products in single precision.

Interleaved, ``a = Σ re(w) · x`` and ``b = Σ im(w) · x`` give the beam ``(a_re − b_im, a_im + b_re)`` at the end.
"""

import contextlib

from llvmlite import ir
from numba.core import cgutils

from ertis_numba.kernels._cpu.features import INSTRUCTION_SET, passes, vectors_per_pass

__all__ = ["TILE", "Dot32", "Planes"]

TILE = 64  # ranges
_LANES = INSTRUCTION_SET.lanes  # floats in a vector

INT32, FLOAT = ir.IntType(32), ir.FloatType()
_FLOATS, _INDICES = ir.VectorType(FLOAT, _LANES), ir.VectorType(INT32, _LANES)


class _Sums:
    """Rows of vectors of floats that LLVM keeps in registers during a pass over a tile."""

    def __init__(self, builder, n_rows, n_vectors, ranges_each):
        self._builder = builder
        self._vectors = vectors_per_pass(n_vectors, n_rows)
        self._at_a_time = self._vectors * ranges_each
        self._sums = [[cgutils.alloca_once(builder, _FLOATS) for _ in range(self._vectors)] for _ in range(n_rows)]

    @contextlib.contextmanager
    def passes(self, size):
        """Emit a loop over the passes of a tile, with sums of 0; yield the first range of a pass."""
        with passes(self._builder, ir.Constant(size, TILE), TILE, self._at_a_time) as first:
            for row in self._sums:
                for total in row:
                    self._builder.store(ir.Constant(_FLOATS, [0.0] * _LANES), total)
            yield first

    def _splat(self, pointer, index):
        """Return the number at ``pointer[index]`` in every lane."""
        blank, zeros = ir.Constant(_FLOATS, ir.Undefined), ir.Constant(_INDICES, [0] * _LANES)
        number = self._builder.load(self._builder.gep(pointer, [index]))
        first = self._builder.insert_element(blank, number, ir.Constant(INT32, 0))
        return self._builder.shuffle_vector(first, blank, zeros)

    def _load(self, pointer, index, ahead):
        place = self._builder.gep(pointer, [self._builder.add(index, ir.Constant(index.type, ahead))])
        loaded = self._builder.load(self._builder.bitcast(place, _FLOATS.as_pointer()))
        loaded.align = 4
        return loaded

    def _add_product(self, row, vector, x, weight):
        builder, total = self._builder, self._sums[row][vector]
        product = builder.fmul(x, weight, flags=("contract",))
        builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

    def _magnitude(self, x, y):
        builder = self._builder
        function = ir.FunctionType(_FLOATS, [_FLOATS])
        root = cgutils.get_or_insert_function(builder.module, function, f"llvm.sqrt.v{_LANES}f32")
        return builder.call(root, [builder.fadd(builder.fmul(x, x), builder.fmul(y, y))])

    def _store(self, value, target, ahead):
        place = self._builder.gep(target, [ir.Constant(ir.IntType(64), ahead)])
        self._builder.store(value, self._builder.bitcast(place, _FLOATS.as_pointer())).align = 4


class Dot32(_Sums):
    """Emits the instructions of one tile of interleaved samples."""

    def __init__(self, builder):
        super().__init__(builder, 2, 2 * TILE // _LANES, _LANES // 2)

    def add_complex_terms(self, signals, offsets, weights, row, first):
        """Add ``Σ_term weights[row, term] · signals.flat[offsets[row, term] + first + k]`` to the sums of all k."""
        builder = self._builder
        samples, pairs = (builder.bitcast(array.data, FLOAT.as_pointer()) for array in (signals, weights))
        n_terms = cgutils.unpack_tuple(builder, offsets.shape)[1]
        begin = builder.mul(row, n_terms)
        one = ir.Constant(row.type, 1)
        with cgutils.for_range(builder, n_terms) as loop:
            entry = builder.add(begin, loop.index)
            offset = builder.sext(builder.load(builder.gep(offsets.data, [entry])), row.type)
            place = builder.shl(builder.add(offset, first), one)
            even = builder.shl(entry, one)
            both = [self._splat(pairs, index) for index in (even, builder.add(even, one))]
            for vector in range(self._vectors):
                x = self._load(samples, place, vector * _LANES)
                for part in (0, 1):
                    self._add_product(part, vector, x, both[part])

    def _parts(self):
        """Yield the real and imaginary parts of the sums, and their first range, vector by vector."""
        builder = self._builder
        even, odd = (ir.Constant(_INDICES, list(range(k, 2 * _LANES, 2))) for k in (0, 1))
        for vector in range(0, self._vectors, 2):
            a, b = ([builder.load(total) for total in row[vector : vector + 2]] for row in self._sums)
            x = builder.fsub(builder.shuffle_vector(*a, even), builder.shuffle_vector(*b, odd))
            y = builder.fadd(builder.shuffle_vector(*a, odd), builder.shuffle_vector(*b, even))
            yield vector * _LANES // 2, x, y

    def store_levels(self, target):
        """Write the magnitude of the sums from ``target`` (float*) on."""
        for ahead, x, y in self._parts():
            self._store(self._magnitude(x, y), target, ahead)

    def store_parts(self, target):
        """Write the sums to ``target`` (float*): real parts, then imaginary parts."""
        for ahead, x, y in self._parts():
            self._store(x, target, ahead)
            self._store(y, target, TILE + ahead)


class Planes(_Sums):
    """Emits the instructions of one tile with separate real and imaginary parts, for one or more beams."""

    def __init__(self, builder, n_beams):
        super().__init__(builder, 2 * n_beams, TILE // _LANES, _LANES)
        self._n_beams = n_beams

    def add_real_term(self, rows, begin, weights, entries):
        """Add ``weights[entries[beam]] · rows[begin + k]``, and the same for the imaginary parts `TILE` further on."""
        splats = [self._splat(weights, entry) for entry in entries]
        for vector in range(self._vectors):
            for part in (0, 1):
                x = self._load(rows, begin, part * TILE + vector * _LANES)
                for beam, weight in enumerate(splats):
                    self._add_product(2 * beam + part, vector, x, weight)

    def store_levels(self, beam, target):
        """Write the magnitude of the sums of a beam from ``target`` (float*) on."""
        for vector in range(self._vectors):
            x, y = (self._builder.load(self._sums[2 * beam + part][vector]) for part in (0, 1))
            self._store(self._magnitude(x, y), target, vector * _LANES)
