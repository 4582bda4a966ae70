"""Vectorised sums of 16-bit products, with the CPU's dot-product instruction.

One instruction (``vpdpwssd``) multiplies pairs of 16-bit numbers, and adds the two products of each pair to a 32-bit
sum. A complex sample is such a pair. The weights (re w, −im w) yield the real part of a beam, and (im w, re w) its
imaginary part.
"""

from llvmlite import ir
from numba.core import cgutils

from ertis_numba.kernels._cpu.features import target_features

__all__ = ["FLOATS", "HAS_INT16_DOT", "INT32", "LANES", "RANGES", "SHORTS", "SUMS", "VECTORS", "Dot16"]

_FEATURES = target_features()
HAS_INT16_DOT = not _FEATURES.isdisjoint({"avx512vnni", "avxvnni"})
LANES = 16 if "avx512vnni" in _FEATURES else 8  # pairs in a vector
VECTORS = 6  # per part: 12 chains of additions hide the instruction's latency
RANGES = VECTORS * LANES  # of one tile

INT16, INT32, FLOAT = ir.IntType(16), ir.IntType(32), ir.FloatType()
SUMS, PAIRS, FLOATS = ir.VectorType(INT32, LANES), ir.VectorType(INT16, 2 * LANES), ir.VectorType(FLOAT, LANES)
SHORTS = ir.VectorType(INT16, LANES)


class Dot16:
    """Emits the instructions of one tile: sums of both parts of `VECTORS` vectors of ranges, kept in registers."""

    def __init__(self, builder):
        self._builder = builder
        name = f"llvm.x86.avx512.vpdpwssd.{32 * LANES}"
        self._dot = cgutils.get_or_insert_function(builder.module, ir.FunctionType(SUMS, [SUMS, PAIRS, PAIRS]), name)
        root = ir.FunctionType(FLOATS, [FLOATS])
        self._root = cgutils.get_or_insert_function(builder.module, root, f"llvm.sqrt.v{LANES}f32")
        self._sums = [[cgutils.alloca_once(builder, SUMS) for _ in range(VECTORS)] for _ in ("re", "im")]
        for total in self._sums[0] + self._sums[1]:
            builder.store(ir.Constant(SUMS, [0] * LANES), total)

    def splat(self, value, vector):
        """Return ``value`` in every lane."""
        blank = ir.Constant(vector, ir.Undefined)
        first = self._builder.insert_element(blank, value, ir.Constant(INT32, 0))
        return self._builder.shuffle_vector(first, blank, ir.Constant(SUMS, [0] * LANES))

    def pair(self, pairs, index):
        """Return the pair of weights at ``pairs[index]`` in every lane."""
        weight = self._builder.load(self._builder.gep(pairs, [index]))
        return self._builder.bitcast(self.splat(weight, SUMS), PAIRS)

    def load(self, pairs, index, vector, align):
        """Return a vector of pairs starting at ``pairs[index + vector · LANES]``."""
        builder = self._builder
        place = builder.gep(pairs, [builder.add(index, ir.Constant(index.type, vector * LANES))])
        loaded = builder.load(builder.bitcast(place, PAIRS.as_pointer()))
        loaded.align = align
        return loaded

    def add(self, part, vector, x, weight):
        """Add the products of ``x`` and ``weight`` to a sum."""
        total = self._sums[part][vector]
        self._builder.store(self._builder.call(self._dot, [self._builder.load(total), x, weight]), total)

    def complex_terms(self, tiles, tile, offsets, weights, row):
        """Add ``Σ_term weights[row, term] · tiles[tile].flat[offsets[row, term] + k]`` to the sums of all k."""
        n_terms = cgutils.unpack_tuple(self._builder, offsets.shape)[1]
        self.flat_terms(tiles, tile, offsets, weights, self._builder.mul(row, n_terms), n_terms)

    def flat_terms(self, tiles, tile, offsets, weights, begin, n_terms):
        """Add ``Σ_term weights.flat[begin + term] · tiles[tile].flat[offsets.flat[begin + term] + k]`` likewise."""
        builder = self._builder
        shape = cgutils.unpack_tuple(builder, tiles.shape)
        in_tile = builder.mul(builder.mul(shape[1], shape[2]), shape[3])
        samples = builder.gep(builder.bitcast(tiles.data, INT32.as_pointer()), [builder.mul(tile, in_tile)])
        pairs = builder.bitcast(weights.data, INT32.as_pointer())
        with cgutils.for_range(builder, n_terms) as loop:
            entry = builder.add(begin, loop.index)
            offset = builder.sext(builder.load(builder.gep(offsets.data, [entry])), begin.type)
            even = builder.shl(entry, ir.Constant(begin.type, 1))
            both = [self.pair(pairs, index) for index in (even, builder.add(even, ir.Constant(begin.type, 1)))]
            for vector in range(VECTORS):
                x = self.load(samples, offset, vector, align=4)
                for part in (0, 1):
                    self.add(part, vector, x, both[part])

    def node_pairs(self, pairs, skipped, places, weights, first_pair, n_pairs):
        """Add the beams of grid points, stored in pairs from point ``skipped`` on, times their weights.

        ``places`` and ``weights`` are flat arrays; the direction has ``n_pairs`` entries from ``first_pair`` on.
        """
        builder = self._builder
        size = first_pair.type
        values = builder.bitcast(weights.data, INT32.as_pointer())
        with cgutils.for_range(builder, n_pairs) as loop:
            entry = builder.add(first_pair, loop.index)
            node = builder.sext(builder.load(builder.gep(places.data, [entry])), size)
            begin = builder.mul(builder.sub(node, skipped), ir.Constant(size, 2 * RANGES))
            weight = self.pair(values, entry)
            for vector in range(VECTORS):
                for part in (0, 1):
                    at = builder.add(begin, ir.Constant(size, part * RANGES))
                    self.add(part, vector, self.load(pairs, at, vector, align=4 * LANES), weight)

    def store_parts(self, scale, target):
        """Write ``scale`` times the sums to ``target`` (float*): real parts, then imaginary parts."""
        builder = self._builder
        scales = self.splat(scale, FLOATS)
        for part in (0, 1):
            for vector in range(VECTORS):
                value = builder.fmul(builder.sitofp(builder.load(self._sums[part][vector]), FLOATS), scales)
                place = builder.gep(target, [ir.Constant(ir.IntType(64), part * RANGES + vector * LANES)])
                builder.store(value, builder.bitcast(place, FLOATS.as_pointer())).align = 4

    def store_levels(self, scale, target):
        """Write ``scale`` times the magnitude of the sums to ``target`` (float*)."""
        builder = self._builder
        scales = self.splat(scale, FLOATS)
        for vector in range(VECTORS):
            x, y = (builder.sitofp(builder.load(self._sums[part][vector]), FLOATS) for part in (0, 1))
            power = builder.fadd(builder.fmul(x, x), builder.fmul(y, y))
            level = builder.fmul(builder.call(self._root, [power]), scales)
            place = builder.gep(target, [ir.Constant(ir.IntType(64), vector * LANES)])
            builder.store(level, builder.bitcast(place, FLOATS.as_pointer())).align = 4

    def store_upper_halves(self, target):
        """Write the rounded upper 16 bits of the sums to ``target`` (int16*): real parts, then imaginary parts."""
        builder = self._builder
        half, shift = (ir.Constant(SUMS, [number] * LANES) for number in (1 << 15, 16))
        for part in (0, 1):
            for vector in range(VECTORS):
                rounded = builder.ashr(builder.add(builder.load(self._sums[part][vector]), half), shift)
                place = builder.gep(target, [ir.Constant(ir.IntType(64), part * RANGES + vector * LANES)])
                stored = builder.store(builder.trunc(rounded, SHORTS), builder.bitcast(place, SHORTS.as_pointer()))
                stored.align = 2
