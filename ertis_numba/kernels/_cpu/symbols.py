# mypy: ignore-errors
"""Sums of the taps of set bits by tables: the bits of consecutive words of a microphone are a symbol."""

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.features import INSTRUCTION_SET

__all__ = ["GROUP", "SYMBOL", "bits_of", "fill_symbols", "load_lanes", "store_lanes", "sum_symbols", "tables_of"]

GROUP = 4  # outputs summed in parallel: enough chains to hide the latency of an addition
SYMBOL = max(1, INSTRUCTION_SET.symbol_bits)  # words per symbol
_OCTETS = SYMBOL == 3  # A table of 16-bit numbers is looked up by octets.


def load_lanes(builder, data, index, count):
    """Return ``count`` numbers from ``data[index]`` on."""
    place = builder.bitcast(builder.gep(data, [index]), ir.VectorType(data.type.pointee, count).as_pointer())
    loaded = builder.load(place)
    loaded.align = 2
    return loaded


def store_lanes(builder, vector, data, index):
    """Set the numbers from ``data[index]`` on to a vector."""
    place = builder.bitcast(builder.gep(data, [index]), vector.type.as_pointer())
    builder.store(vector, place).align = 2


def _row(builder, row, count):
    return builder.mul(row, row.type(count))


def bits_of(builder, word, vector):
    """Return a mask with the bit of each lane. Without mask registers, each lane tests a bit of the word."""
    if INSTRUCTION_SET.has_masks:
        return builder.bitcast(word, ir.VectorType(ir.IntType(1), vector.count))
    lanes, number = vector.count, vector.element.width
    n_pieces = max(1, lanes // number)
    whole = ir.VectorType(ir.IntType(n_pieces * number), lanes // n_pieces)
    blank, index = ir.Constant(whole, ir.Undefined), ir.IntType(32)
    word = builder.insert_element(blank, builder.zext(word, whole.element), ir.Constant(index, 0))
    zeros = ir.Constant(ir.VectorType(index, whole.count), [0] * whole.count)
    pieces = builder.bitcast(builder.shuffle_vector(word, blank, zeros), vector)
    tested = ir.Constant(vector, [1 << lane // n_pieces for lane in range(lanes)])
    return builder.icmp_unsigned("!=", builder.and_(pieces, tested), ir.Constant(vector, [0] * lanes))


@njit(nogil=True, cache=True)
def tables_of(taps):
    """Return the sums of taps for each symbol, by the number of bits of the first symbol before the first tap."""
    tables = np.zeros((SYMBOL, (taps.size + 2 * SYMBOL - 2) // SYMBOL, 1 << SYMBOL), taps.dtype)
    for before in range(SYMBOL):
        for place in range(tables.shape[1] * SYMBOL):
            tap = taps[place - before] if 0 <= place - before < taps.size else 0
            table, size = tables[before, place // SYMBOL], 1 << place % SYMBOL
            for k in range(size):
                table[size + k] = table[k] + tap
    return tables


@intrinsic
def fill_symbols(typing_context, words, first, symbols):
    """Fill ``symbols``, (symbol, lane), with the bits of `SYMBOL` words each, from ``words.flat[first]`` on."""
    signature = types.void(words, types.intp, symbols)

    def codegen(context, builder, signature, arguments):
        words, symbols = (context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (0, 2))
        number, lanes = signature.args[2].dtype.bitwidth, signature.args[0].dtype.bitwidth
        vector = ir.VectorType(ir.IntType(number), lanes)
        n_words = cgutils.unpack_tuple(builder, words.shape)[1]
        in_octets = _OCTETS and number == 16  # An octet has its index, twice the symbol and 1 for the upper octet.
        with cgutils.for_range(builder, cgutils.unpack_tuple(builder, symbols.shape)[0]) as loop:
            total = ir.Constant(vector, [0x0100 if in_octets else 0] * lanes)
            for bit in range(SYMBOL):
                ahead = builder.add(_row(builder, loop.index, SYMBOL), loop.index.type(bit))
                place = builder.add(arguments[1], builder.mul(ahead, n_words))
                is_set = bits_of(builder, builder.load(builder.gep(words.data, [place])), vector)
                weight = ir.Constant(vector, [(0x0202 if in_octets else 1) << bit] * lanes)
                total = builder.or_(total, builder.select(is_set, weight, ir.Constant(vector, [0] * lanes)))
            store_lanes(builder, total, symbols.data, _row(builder, loop.index, lanes))
        return context.get_dummy_value()

    return signature, codegen


def _look_up(builder, table, symbols):
    """Return the entries of a table, a vector, for a vector of symbols, as many at a time as a register holds."""
    number, index = table.type.element.width, ir.IntType(32)

    def chosen(values, first, count):
        lanes = [(first + k) % values.type.count for k in range(count)]
        return builder.shuffle_vector(
            values, ir.Constant(values.type, ir.Undefined), ir.Constant(ir.VectorType(index, count), lanes)
        )

    def call(name, *vectors):
        function = ir.FunctionType(vectors[0].type, [vector.type for vector in vectors])
        return builder.call(cgutils.get_or_insert_function(builder.module, function, name), vectors)

    width = 32 * INSTRUCTION_SET.lanes // number
    vector, octets = ir.VectorType(ir.IntType(number), width), ir.VectorType(ir.IntType(8), width * number // 8)
    found = []
    for first in range(0, symbols.type.count, width):
        piece = chosen(symbols, first, width)
        if _OCTETS and number == 16:  # The table is in both halves, within which octets are looked up.
            both = (builder.bitcast(each, octets) for each in (chosen(table, 0, width), piece))
            found.append(builder.bitcast(call("llvm.x86.avx2.pshuf.b", *both), vector))
        elif _OCTETS:
            found.append(call("llvm.x86.avx2.permd", table, piece))
        elif number == 16:
            found.append(call("llvm.x86.avx512.permvar.hi.512", table, piece))
        else:
            low, high = (chosen(table, half, width) for half in (0, width))
            found.append(call("llvm.x86.avx512.vpermi2var.d.512", low, piece, high))
    while len(found) > 1:
        every = ir.Constant(ir.VectorType(index, 2 * found[0].type.count), list(range(2 * found[0].type.count)))
        found = [builder.shuffle_vector(*pair, every) for pair in zip(found[::2], found[1::2], strict=True)]
    return chosen(found[0], 0, symbols.type.count)


@intrinsic
def sum_symbols(typing_context, symbols, tables, first, step, words, tile, row):
    """Fill rows ``row … row + GROUP`` of ``tile`` (output, lane) with the sums of the taps of set bits.

    The taps of row g begin ``first + g · step`` words after the first symbol.
    """
    signature = types.void(symbols, tables, types.intp, types.intp, words, tile, types.intp)

    def codegen(context, builder, signature, arguments):
        symbols, tables, tile = (
            context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (0, 1, 5)
        )
        size, (first, step), row = arguments[2].type, arguments[2:4], arguments[6]
        vector = ir.VectorType(symbols.data.type.pointee, signature.args[4].dtype.bitwidth)
        n_terms = cgutils.unpack_tuple(builder, tables.shape)[1]
        sums = [cgutils.alloca_once(builder, vector) for _ in range(GROUP)]
        starts = []
        for g, total in enumerate(sums):
            builder.store(ir.Constant(vector, [0] * vector.count), total)
            at = builder.add(first, builder.mul(step, size(g)))
            before = builder.srem(at, size(SYMBOL))
            starts.append((builder.sdiv(at, size(SYMBOL)), builder.mul(before, n_terms)))
        with cgutils.for_range(builder, n_terms) as loop:
            for (symbol, term), total in zip(starts, sums, strict=True):
                place = _row(builder, builder.add(symbol, loop.index), vector.count)
                entry = _row(builder, builder.add(term, loop.index), 1 << SYMBOL)
                table = load_lanes(builder, tables.data, entry, 1 << SYMBOL)
                found = _look_up(builder, table, load_lanes(builder, symbols.data, place, vector.count))
                builder.store(builder.add(builder.load(total), found), total)
        for g, total in enumerate(sums):
            place = _row(builder, builder.add(row, size(g)), vector.count)
            store_lanes(builder, builder.load(total), tile.data, place)
        return context.get_dummy_value()

    return signature, codegen
