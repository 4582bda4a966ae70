"""Unpack, decimate and remove the group delay in one pass over the PDM words.

The bits of a few consecutive words of a microphone are a symbol. One instruction looks up what each microphone's symbol
adds to an output. Without it, ``sums += bits(word) ? tap : 0`` adds one tap for all microphones. Then ``x = 2 · bit −
1``.
"""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.features import INSTRUCTION_SET
from ertis_numba.kernels._cpu.lanes import transposed
from ertis_numba.kernels._cpu.spans import clear
from ertis_numba.kernels._cpu.symbols import (
    GROUP,
    SYMBOL,
    bits_of,
    fill_symbols,
    load_lanes,
    store_lanes,
    sum_symbols,
    tables_of,
)

__all__ = ["demodulate_words"]

_HAS_MASKS = INSTRUCTION_SET.has_masks
_TILE = 64  # outputs collected before they are transposed from (sample, mic) to (mic, sample)
_SIDE = min(8, INSTRUCTION_SET.lanes)  # of the squares that are transposed; words have 8 bits or more


@intrinsic
def _sum_masked_taps(typing_context, words, first, step, taps, tile, row):
    """Fill rows ``row … row + GROUP`` of ``tile`` (output, lane) with the sums of the masked taps.

    ``tile[row + g, lane] = Σ_t taps[t] · bit_of(words.flat[first + g · step + t · n_words])`` for the bit of `_lane`.
    The code uses LLVM's vector types, because no loop over bits keeps the sums of a whole word in registers.
    """
    signature = types.void(words, types.intp, types.intp, taps, tile, types.intp)

    def codegen(context, builder, signature, arguments):
        words_value, first, step, taps_value, tile_value, row = arguments
        lanes = signature.args[0].dtype.bitwidth
        words_array = context.make_array(signature.args[0])(context, builder, words_value)
        taps_array = context.make_array(signature.args[3])(context, builder, taps_value)
        tile_array = context.make_array(signature.args[4])(context, builder, tile_value)
        n_words = cgutils.unpack_tuple(builder, words_array.shape)[1]
        n_taps = cgutils.unpack_tuple(builder, taps_array.shape)[0]
        number = signature.args[3].dtype.bitwidth
        vector = ir.VectorType(ir.IntType(number), lanes)
        lane_0 = ir.Constant(ir.IntType(32), 0)
        all_lanes_0 = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
        zero = ir.Constant(vector, [0] * lanes)
        blank = ir.Constant(vector, ir.Undefined)

        sums = [cgutils.alloca_once(builder, vector) for _ in range(GROUP)]
        for total in sums:
            builder.store(zero, total)
        starts = [builder.add(first, builder.mul(step, ir.Constant(step.type, g))) for g in range(GROUP)]
        with cgutils.for_range(builder, n_taps) as loop:
            tap = builder.load(builder.gep(taps_array.data, [loop.index]))
            tap = builder.shuffle_vector(builder.insert_element(blank, tap, lane_0), blank, all_lanes_0)
            ahead = builder.mul(loop.index, n_words)
            for start, total in zip(starts, sums, strict=True):
                word = builder.load(builder.gep(words_array.data, [builder.add(start, ahead)]))
                is_set = bits_of(builder, word, vector)
                chosen = builder.select(is_set, tap, zero)
                builder.store(builder.add(builder.load(total), chosen), total)
        for g, total in enumerate(sums):
            place = builder.mul(builder.add(row, ir.Constant(row.type, g)), ir.Constant(row.type, lanes))
            target = builder.bitcast(builder.gep(tile_array.data, [place]), vector.as_pointer())
            builder.store(builder.load(total), target).align = number // 8
        return context.get_dummy_value()

    return signature, codegen


@njit(nogil=True, cache=True)
def _lane(bit, word_bits, tap_bits):
    """Return the lane of a bit. Without mask registers, consecutive lanes hold consecutive pieces of the word."""
    if _HAS_MASKS:
        return bit
    return bit // tap_bits + bit % tap_bits * max(1, word_bits // tap_bits)


@njit(nogil=True, cache=True)
def _fill_by_symbols(words, start, word, factor, taps, tables, tile, count):
    """Fill ``count`` rows of ``tile`` (output, lane) with the sums of the taps of set bits, from ``start`` on."""
    symbols = np.empty(((_TILE - 1) * factor // SYMBOL + tables.shape[1], tile.shape[1]), taps.dtype)
    fill_symbols(words, start * words.shape[1] + word, symbols[: (count - 1) * factor // SYMBOL + tables.shape[1]])
    for row in range(0, count, GROUP):
        sum_symbols(symbols, tables, row * factor, factor, words, tile, row)


@njit(nogil=True, cache=True)
def _fill_by_masks(words, start, word, factor, taps, tables, tile, count):
    """Fill a tile likewise; ``tables`` are unused."""
    for row in range(0, count, GROUP):
        at = (start + row * factor) * words.shape[1] + word
        _sum_masked_taps(words, at, factor * words.shape[1], taps, tile, row)


_fill_tile = _fill_by_symbols if INSTRUCTION_SET.symbol_bits else _fill_by_masks


@njit(nogil=True, cache=True)
def _mics_of_lanes(channels, word, word_bits, tap_bits):
    """Return the microphone in each lane of a word; −1 for none."""
    mics = np.full(word_bits, -1, np.int32)
    for mic in range(channels.size):
        if channels[mic] // word_bits == word:
            mics[_lane(channels[mic] % word_bits, word_bits, tap_bits)] = mic
    return mics


@intrinsic
def _turn_square(typing_context, tile, row, lane, tap_total, scale, mics, out, first):
    """Fill ``out[mics[lane + k], first + row + n]`` from ``tile[row + n, lane + k]``, `_SIDE` squared; −1 for none."""
    size = types.intp
    signature = types.void(tile, size, size, types.int32, types.float32, mics, out, size)

    def codegen(context, builder, signature, arguments):
        tile, mics, out = (context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (0, 5, 6))
        _, row, lane, tap_total, scale, _, _, first = arguments
        n_lanes, length = (cgutils.unpack_tuple(builder, each.shape)[1] for each in (tile, out))
        whole, number = (ir.VectorType(kind, _SIDE) for kind in (ir.IntType(32), ir.FloatType()))

        def splat(value, vector):
            one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.IntType(32)(0))
            return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), ir.Constant(whole, [0] * _SIDE))

        total, factor = splat(tap_total, whole), splat(scale, number)
        rows = []
        for n in range(_SIDE):
            at = builder.add(builder.mul(builder.add(row, row.type(n)), n_lanes), lane)
            sums = load_lanes(builder, tile.data, at, _SIDE)
            sums = sums if sums.type == whole else builder.sext(sums, whole)
            rows.append(builder.fmul(builder.sitofp(builder.sub(builder.add(sums, sums), total), number), factor))
        column = builder.add(first, row)
        for k, values in enumerate(transposed(builder, rows)):
            mic = builder.sext(builder.load(builder.gep(mics.data, [builder.add(lane, lane.type(k))])), ir.IntType(64))
            with builder.if_then(builder.icmp_signed(">=", mic, mic.type(0))):
                store_lanes(builder, values, out.data, builder.add(builder.mul(mic, length), column))
        return context.get_dummy_value()

    return signature, codegen


@njit(nogil=True, cache=True)
def _turn_tile(tile, tap_total, scale, mics, begin, end, out):
    """Write the sums of one word's channels, from ``tile`` (sample, lane) to ``out`` (mic, sample)."""
    is_whole = end - begin == _TILE
    short = np.empty((1 if is_whole else out.shape[0], _TILE), np.float32)
    for lane in range(0, mics.size, _SIDE):
        for row in range(0, _TILE, _SIDE):
            if is_whole:
                _turn_square(tile, row, lane, tap_total, scale, mics, out, begin)
            else:
                _turn_square(tile, row, lane, tap_total, scale, mics, short, 0)
    if not is_whole:
        for mic in mics:
            if mic >= 0:
                for n in range(end - begin):
                    out[mic, begin + n] = short[mic, n]


@njit(nogil=True, cache=True)
def _filter_at_edge(words, channels, taps, scale, factor, first, begin, end, out):
    """Fill samples ``begin … end`` of all microphones if taps extend beyond an end of the record; x is 0 there."""
    word_bits = words.itemsize * 8
    for mic in range(channels.size):
        word, bit = channels[mic] // word_bits, np.uint64(channels[mic] % word_bits)
        for n in range(begin, end):
            start = (first + n) * factor - taps.size // 2
            total = np.int32(0)
            for tap in range(max(0, -start), min(taps.size, words.shape[0] - start)):
                sign = 2 * (np.int64(words[start + tap, word] >> bit) & 1) - 1
                total += np.int32(taps[tap] * sign)
            out[mic, n] = np.float32(total) * scale


@njit(parallel=True, nogil=True, cache=True)
def demodulate_words(words, channels, taps, scale, factor, first, n_outputs, out):
    """Unpack, decimate and remove the group delay in one pass over the words."""
    n_samples, n_words = words.shape
    word_bits = words.itemsize * 8
    tap_total = np.int32(0)
    for tap in range(taps.size):
        tap_total += np.int32(taps[tap])
    tables = tables_of(taps)
    for block in prange((out.shape[1] + _TILE - 1) // _TILE):
        begin = block * _TILE
        end = max(begin, min(begin + _TILE, n_outputs))
        start = (first + begin) * factor - taps.size // 2
        count = (end - begin + GROUP - 1) // GROUP * GROUP
        n_used = ((count - 1) * factor // SYMBOL + tables.shape[1]) * SYMBOL
        if begin == end:
            pass
        elif start < 0 or start + n_used > n_samples:
            _filter_at_edge(words, channels, taps, scale, factor, first, begin, end, out)
        else:
            tile = np.empty((_TILE, word_bits), taps.dtype)
            for word in range(n_words):
                _fill_tile(words, start, word, factor, taps, tables, tile, count)
                mics = _mics_of_lanes(channels, word, word_bits, 8 * taps.itemsize)
                _turn_tile(tile, tap_total, scale, mics, begin, end, out)
        clear(out, end, min(begin + _TILE, out.shape[1]))
