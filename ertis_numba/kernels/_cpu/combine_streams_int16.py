# mypy: ignore-errors
"""Amplitudes from delay-and-sums of streams on 16-bit samples, without writing the sums to memory."""

import numpy as np
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.amplitudes import amplitudes_of
from ertis_numba.kernels._cpu.dot16 import INT32, RANGES, Dot16
from ertis_numba.kernels._cpu.grid_beams16 import fill_pairs, new_pairs
from ertis_numba.kernels._cpu.spans import node_span, prefetch_row

__all__ = ["combine_streams_int16"]

_BLOCK = 1536  # directions: every thread gets some, and few grid points are summed twice
_AHEAD = 4  # directions between the prefetch of a row and its use


@intrinsic
def _sum_terms(typing_context, tiles, tile, offsets, weights, begin, n_terms, scale, sums, place):
    """Fill ``sums.flat[place …]``, (part, range), with the beam of ``n_terms`` flat entries from ``begin`` on."""
    signature = types.void(tiles, types.intp, offsets, weights, types.intp, types.intp, types.float32, sums, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        dot = Dot16(builder)
        with dot.passes(arguments[4].type(RANGES)) as first:
            dot.add_flat_terms(array(0), arguments[1], array(2), array(3), arguments[4], arguments[5], first)
            dot.store_parts(arguments[6], builder.gep(array(7).data, [builder.add(arguments[8], first)]))
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def _sum_nodes(typing_context, pairs, skipped, places, weights, first_pair, n_pairs, scale, sums, place):
    """Fill ``sums.flat[place …]`` from pairs of grid points, whose first point is ``skipped``."""
    signature = types.void(pairs, types.intp, places, weights, types.intp, types.intp, types.float32, sums, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        size, dot = arguments[4].type, Dot16(builder)
        values = builder.bitcast(array(3).data, INT32.as_pointer())
        with dot.passes(size(RANGES)) as first:
            with cgutils.for_range(builder, arguments[5]) as loop:
                entry = builder.add(arguments[4], loop.index)
                node = builder.sext(builder.load(builder.gep(array(2).data, [entry])), size)
                begin = builder.mul(builder.sub(node, arguments[1]), size(2 * RANGES))
                dot.add_real_term(array(0).data, builder.add(begin, first), [dot.pair(values, entry)])
            dot.store_parts(arguments[6], builder.gep(array(7).data, [builder.add(arguments[8], first)]))
        return context.get_dummy_value()

    return signature, codegen


@njit(nogil=True, cache=True)
def _spans(shapes, places, n_directions, begin, end, spans):
    """Fill ``spans``, (stream, 3), with the first and last grid point of the directions, and the row of the first."""
    row = first_place = 0
    for stream in range(shapes.shape[0]):
        n_pairs = shapes[stream, 2]
        spans[stream, 2] = row
        if n_pairs:
            size = n_directions * n_pairs
            mine = places[first_place : first_place + size].reshape(n_directions, n_pairs)
            spans[stream, 0], spans[stream, 1] = node_span(mine, begin, end)
            row += spans[stream, 1] - spans[stream, 0] + 1
            first_place += size
    return row


@njit(parallel=True, nogil=True, cache=True)
def combine_streams_int16(
    tiles,
    scales,
    starts,
    stop,
    shapes,
    offsets,
    weights,
    places,
    tap_weights,
    rows,
    recipe,
    out,
):
    """Compute amplitudes from delay-and-sums of streams on 16-bit tiles."""
    n_powers, order, beam, total, bound = recipe
    n_directions = out.shape[0]
    n_tiles, n_streams, n_mics, n_phases, width, _ = tiles.shape
    flat = tiles.reshape(n_tiles * n_streams, n_mics, n_phases, width, 2)
    n_blocks = (n_directions + _BLOCK - 1) // _BLOCK
    block = (n_directions + n_blocks - 1) // n_blocks
    for part in prange(n_tiles * n_blocks):
        tile = part // n_blocks
        begin = min(part % n_blocks * block, n_directions)
        end = min(begin + block, n_directions)
        if begin == end:
            continue
        spans = np.empty((n_streams, 3), np.int64)
        pairs = new_pairs(_spans(shapes, places, n_directions, begin, end, spans))
        entry = 0
        for stream in range(n_streams):
            n_points, n_terms = np.int64(shapes[stream, 0]), np.int64(shapes[stream, 1])
            size = n_points * n_terms
            if shapes[stream, 2]:
                first, last, row = spans[stream]
                fill_pairs(
                    flat,
                    tile * n_streams + stream,
                    offsets[entry : entry + size].reshape(n_points, n_terms),
                    weights[entry : entry + size].reshape(n_points, n_terms, 2, 2),
                    first,
                    last,
                    RANGES,
                    pairs[row : row + last - first + 1],
                )
            entry += size
        sums = np.empty((n_streams, 2, RANGES), np.float32)
        work = np.empty((order, 2, RANGES), np.float32)
        unit = scales[tile, total] * np.float32(bound) if total >= 0 else np.float32(0)
        least = np.float32(n_mics) / unit if unit > 0 else np.float32(0)
        short = np.empty((1, RANGES), np.float32)
        is_whole = starts[tile] + RANGES <= stop
        for direction in range(begin, end):
            prefetch_row(out, rows[min(direction + _AHEAD, end - 1)], np.int64(starts[tile]), RANGES)
            entry = place = 0
            for stream in range(n_streams):
                n_points, n_terms, n_pairs = shapes[stream, 0], np.int64(shapes[stream, 1]), np.int64(shapes[stream, 2])
                scale = scales[tile, stream]
                target = stream * 2 * RANGES
                if n_pairs:
                    # Rows of pairs are counted from the first pair of this stream.
                    skipped = spans[stream, 0] - spans[stream, 2]
                    at = place + direction * n_pairs
                    _sum_nodes(pairs, skipped, places, tap_weights, at, n_pairs, scale, sums, target)
                    place += n_directions * n_pairs
                else:
                    at = entry + direction * n_terms
                    _sum_terms(flat, tile * n_streams + stream, offsets, weights, at, n_terms, scale, sums, target)
                entry += n_points * n_terms
            if is_whole:
                target = rows[direction] * np.int64(out.shape[1]) + starts[tile]
                amplitudes_of(sums, n_powers, order, beam, total, np.float32(n_mics), least, work, out, target)
            else:
                amplitudes_of(sums, n_powers, order, beam, total, np.float32(n_mics), least, work, short, 0)
                out[rows[direction], starts[tile] : stop] = short[0, : stop - starts[tile]]
