"""Vectorised sums of complex products in single precision.

Signals stay interleaved (re, im, re, im …). With ``a = Σ re(w) · x`` and ``b = Σ im(w) · x`` as plain vectors of
floats, the beam is ``(a_re − b_im, a_im + b_re)``. A term therefore costs two multiply-adds per loaded vector and no
shuffle. The parts are combined once, at the end.
"""

from llvmlite import ir
from numba.core import cgutils

__all__ = ["LANES", "TILE", "Dot32", "Planes"]

LANES = 16  # floats in a vector; LLVM splits it if registers are narrower
_VECTORS = 8  # per sum: two sums of 8 take half of the 32 registers of AVX-512
_HALF = LANES // 2  # complex numbers in a vector
TILE = _VECTORS * _HALF  # ranges

INT32, FLOAT = ir.IntType(32), ir.FloatType()
FLOATS, HALVES = ir.VectorType(FLOAT, LANES), ir.VectorType(FLOAT, _HALF)


class _Sums:
    """Two rows of vectors of floats that LLVM keeps in registers."""

    def __init__(self, builder, count):
        self._builder = builder
        self._sums = [[cgutils.alloca_once(builder, FLOATS) for _ in range(count)] for _ in "ab"]
        for total in self._sums[0] + self._sums[1]:
            builder.store(ir.Constant(FLOATS, [0.0] * LANES), total)

    def _splat(self, pointer, index):
        """Return the number at ``pointer[index]`` in every lane."""
        blank, zeros = ir.Constant(FLOATS, ir.Undefined), ir.Constant(ir.VectorType(INT32, LANES), [0] * LANES)
        number = self._builder.load(self._builder.gep(pointer, [index]))
        first = self._builder.insert_element(blank, number, ir.Constant(INT32, 0))
        return self._builder.shuffle_vector(first, blank, zeros)

    def _load(self, pointer, index, ahead):
        place = self._builder.gep(pointer, [self._builder.add(index, ir.Constant(index.type, ahead))])
        loaded = self._builder.load(self._builder.bitcast(place, FLOATS.as_pointer()))
        loaded.align = 4
        return loaded

    def _add_product(self, part, vector, x, weight):
        builder, total = self._builder, self._sums[part][vector]
        product = builder.fmul(x, weight, flags=("contract",))
        builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)

    def _magnitude(self, x, y):
        builder = self._builder
        function = ir.FunctionType(x.type, [x.type])
        root = cgutils.get_or_insert_function(builder.module, function, f"llvm.sqrt.v{x.type.count}f32")
        return builder.call(root, [builder.fadd(builder.fmul(x, x), builder.fmul(y, y))])

    def _store(self, value, target, ahead):
        place = self._builder.gep(target, [ir.Constant(ir.IntType(64), ahead)])
        self._builder.store(value, self._builder.bitcast(place, value.type.as_pointer())).align = 4


class Dot32(_Sums):
    """Emits the instructions of one tile of interleaved samples."""

    def __init__(self, builder):
        super().__init__(builder, _VECTORS)

    def complex_terms(self, signals, offsets, weights, row, first):
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
            for vector in range(_VECTORS):
                x = self._load(samples, place, vector * LANES)
                for part in (0, 1):
                    self._add_product(part, vector, x, both[part])

    def _parts(self):
        """Yield the real and imaginary parts of the sums, vector by vector."""
        builder = self._builder
        blank = ir.Constant(FLOATS, ir.Undefined)
        indices = ir.VectorType(INT32, _HALF)
        even, odd = (ir.Constant(indices, list(range(k, LANES, 2))) for k in (0, 1))
        for vector in range(_VECTORS):
            a, b = (builder.load(row[vector]) for row in self._sums)
            x = builder.fsub(builder.shuffle_vector(a, blank, even), builder.shuffle_vector(b, blank, odd))
            y = builder.fadd(builder.shuffle_vector(a, blank, odd), builder.shuffle_vector(b, blank, even))
            yield vector, x, y

    def store_levels(self, target):
        """Write the magnitude of the sums from ``target`` (float*) on."""
        for vector, x, y in self._parts():
            self._store(self._magnitude(x, y), target, vector * _HALF)

    def store_parts(self, target):
        """Write the sums to ``target`` (float*): real parts, then imaginary parts."""
        for vector, x, y in self._parts():
            self._store(x, target, vector * _HALF)
            self._store(y, target, TILE + vector * _HALF)


class Planes(_Sums):
    """Emits the instructions of one tile with separate real and imaginary parts."""

    def __init__(self, builder):
        super().__init__(builder, TILE // LANES)

    def add(self, rows, node, weights, entry):
        """Add ``weights[entry]`` times the beam of grid point ``node`` in ``rows`` (point, part, range)."""
        begin = self._builder.mul(node, ir.Constant(node.type, 2 * TILE))
        weight = self._splat(weights, entry)
        for vector in range(TILE // LANES):
            for part in (0, 1):
                self._add_product(part, vector, self._load(rows, begin, part * TILE + vector * LANES), weight)

    def store_levels(self, target):
        """Write the magnitude of the sums from ``target`` (float*) on."""
        for vector in range(TILE // LANES):
            x, y = (self._builder.load(row[vector]) for row in self._sums)
            self._store(self._magnitude(x, y), target, vector * LANES)
