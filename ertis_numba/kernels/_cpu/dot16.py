"""Vectorised sums of 16-bit products.

A term multiplies pairs, by (re w, −im w) or (im w, re w), and adds both products to a 32-bit sum, which is exact.
"""

import contextlib

from llvmlite import ir
from numba.core import cgutils

from ertis_numba.kernels._cpu.features import INSTRUCTION_SET, passes, vectors_per_pass

__all__ = ["FLOAT", "FLOATS", "INT32", "LANES", "PAIRS", "RANGES", "SHORTS", "SUMS", "TOTALS", "Dot16", "add_products"]

RANGES = 96  # of one tile, on every processor and device, because the samples of a tile share a scale
LANES = INSTRUCTION_SET.lanes  # pairs in a vector

INT16, INT32, FLOAT = ir.IntType(16), ir.IntType(32), ir.FloatType()
SUMS, PAIRS, FLOATS = ir.VectorType(INT32, LANES), ir.VectorType(INT16, 2 * LANES), ir.VectorType(FLOAT, LANES)
SHORTS = ir.VectorType(INT16, LANES)
_MULTIPLIES_PAIRS = bool(INSTRUCTION_SET.multiply_pairs)
TOTALS = SUMS if _MULTIPLIES_PAIRS else ir.VectorType(INT32, 2 * LANES)  # one number per pair, or one per product


def add_products(builder, total, x, weight):
    """Return ``total``, of the type `TOTALS`, plus the products of two vectors of `PAIRS`."""
    if _MULTIPLIES_PAIRS:
        function = ir.FunctionType(SUMS, [PAIRS, PAIRS])
        multiply = cgutils.get_or_insert_function(builder.module, function, INSTRUCTION_SET.multiply_pairs)
        return builder.add(total, builder.call(multiply, [x, weight]))
    return builder.add(total, builder.mul(builder.sext(x, TOTALS), builder.sext(weight, TOTALS)))


class Dot16:
    """Emits the instructions of one tile: ``n_beams`` beams at a time, and as many ranges as registers hold sums of."""

    def __init__(self, builder, n_beams=1):
        self._builder = builder
        self._vectors = vectors_per_pass(RANGES // LANES, 2 * n_beams * (1 if _MULTIPLIES_PAIRS else 2))
        self._sums = [
            [[cgutils.alloca_once(builder, TOTALS) for _ in range(self._vectors)] for _ in ("re", "im")]
            for _ in range(n_beams)
        ]

    @contextlib.contextmanager
    def passes(self, n_used):
        """Emit a loop over the passes of a tile up to ``n_used`` ranges, with sums of 0; yield the first range."""
        with passes(self._builder, n_used, RANGES, self._vectors * LANES) as first:
            for parts in self._sums:
                for total in parts[0] + parts[1]:
                    self._builder.store(ir.Constant(TOTALS, [0] * TOTALS.count), total)
            yield first

    def splat(self, value, vector):
        """Return ``value`` in every lane."""
        blank = ir.Constant(vector, ir.Undefined)
        first = self._builder.insert_element(blank, value, ir.Constant(INT32, 0))
        return self._builder.shuffle_vector(first, blank, ir.Constant(SUMS, [0] * LANES))

    def pair(self, pairs, index):
        """Return the pair of weights at ``pairs[index]`` in every lane."""
        weight = self._builder.load(self._builder.gep(pairs, [index]))
        return self._builder.bitcast(self.splat(weight, SUMS), PAIRS)

    def _load(self, pairs, index, vector, align):
        """Return a vector of pairs starting at ``pairs[index + vector · LANES]``."""
        builder = self._builder
        place = builder.gep(pairs, [builder.add(index, ir.Constant(index.type, vector * LANES))])
        loaded = builder.load(builder.bitcast(place, PAIRS.as_pointer()))
        loaded.align = align
        return loaded

    def _add(self, beam, part, vector, x, weight):
        """Add the products of ``x`` and ``weight`` to a sum."""
        builder, total = self._builder, self._sums[beam][part][vector]
        builder.store(add_products(builder, builder.load(total), x, weight), total)

    def _sum(self, beam, part, vector):
        """Return a vector of sums."""
        total = self._builder.load(self._sums[beam][part][vector])
        if _MULTIPLIES_PAIRS:
            return total
        blank = ir.Constant(TOTALS, ir.Undefined)
        even, odd = (ir.Constant(SUMS, list(range(k, 2 * LANES, 2))) for k in (0, 1))
        return self._builder.add(
            self._builder.shuffle_vector(total, blank, even), self._builder.shuffle_vector(total, blank, odd)
        )

    def add_complex_terms(self, tiles, tile, offsets, weights, row, first):
        """Add ``Σ_term weights[row, term] · tiles[tile].flat[offsets[row, term] + first + k]`` to the sums of all k."""
        n_terms = cgutils.unpack_tuple(self._builder, offsets.shape)[1]
        self.add_flat_terms(tiles, tile, offsets, weights, self._builder.mul(row, n_terms), n_terms, first)

    def add_flat_terms(self, tiles, tile, offsets, weights, begin, n_terms, first):
        """Add the terms of ``n_terms`` flat entries of ``offsets`` and ``weights`` from ``begin`` on likewise."""
        builder = self._builder
        shape = cgutils.unpack_tuple(builder, tiles.shape)
        in_tile = builder.mul(builder.mul(shape[1], shape[2]), shape[3])
        begin_tile = builder.add(builder.mul(tile, in_tile), first)
        samples = builder.gep(builder.bitcast(tiles.data, INT32.as_pointer()), [begin_tile])
        pairs = builder.bitcast(weights.data, INT32.as_pointer())
        with cgutils.for_range(builder, n_terms) as loop:
            entry = builder.add(begin, loop.index)
            offset = builder.sext(builder.load(builder.gep(offsets.data, [entry])), begin.type)
            even = builder.shl(entry, ir.Constant(begin.type, 1))
            both = [self.pair(pairs, index) for index in (even, builder.add(even, ir.Constant(begin.type, 1)))]
            for vector in range(self._vectors):
                x = self._load(samples, offset, vector, align=4)
                for part in (0, 1):
                    self._add(0, part, vector, x, both[part])

    def add_real_term(self, rows, begin, weights):
        """Add ``weights[beam] · rows[begin + k]``, and the same for the imaginary parts `RANGES` further on."""
        for vector in range(self._vectors):
            for part in (0, 1):
                at = self._builder.add(begin, ir.Constant(begin.type, part * RANGES))
                x = self._load(rows, at, vector, align=4 * LANES)
                for beam, weight in enumerate(weights):
                    self._add(beam, part, vector, x, weight)

    def store_parts(self, scale, target):
        """Write ``scale`` times the sums to ``target`` (float*): real parts, then imaginary parts."""
        builder = self._builder
        scales = self.splat(scale, FLOATS)
        for part in (0, 1):
            for vector in range(self._vectors):
                value = builder.fmul(builder.sitofp(self._sum(0, part, vector), FLOATS), scales)
                place = builder.gep(target, [ir.Constant(ir.IntType(64), part * RANGES + vector * LANES)])
                builder.store(value, builder.bitcast(place, FLOATS.as_pointer())).align = 4

    def store_levels(self, beam, scale, target):
        """Write ``scale`` times the magnitude of the sums to ``target`` (float*)."""
        builder = self._builder
        scales = self.splat(scale, FLOATS)
        function = ir.FunctionType(FLOATS, [FLOATS])
        root = cgutils.get_or_insert_function(builder.module, function, f"llvm.sqrt.v{LANES}f32")
        for vector in range(self._vectors):
            x, y = (builder.sitofp(self._sum(beam, part, vector), FLOATS) for part in (0, 1))
            power = builder.fadd(builder.fmul(x, x), builder.fmul(y, y))
            level = builder.fmul(builder.call(root, [power]), scales)
            place = builder.gep(target, [ir.Constant(ir.IntType(64), vector * LANES)])
            builder.store(level, builder.bitcast(place, FLOATS.as_pointer())).align = 4

    def store_upper_halves(self, target):
        """Write the rounded upper 16 bits of the sums to ``target`` (int16*): real parts, then imaginary parts."""
        builder = self._builder
        half, shift = (ir.Constant(SUMS, [number] * LANES) for number in (1 << 15, 16))
        for part in (0, 1):
            for vector in range(self._vectors):
                rounded = builder.ashr(builder.add(self._sum(0, part, vector), half), shift)
                place = builder.gep(target, [ir.Constant(ir.IntType(64), part * RANGES + vector * LANES)])
                stored = builder.store(builder.trunc(rounded, SHORTS), builder.bitcast(place, SHORTS.as_pointer()))
                stored.align = 2
