"""Beams on a coarse grid by delay-and-sum, interpolated to all directions, in single precision."""

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from ertis_numba.kernels._cpu.dot32 import FLOAT, TILE, Dot32, Planes
from ertis_numba.kernels._cpu.spans import node_span, prefetch_row, same_places

__all__ = ["interpolated_beams_envelope"]


@intrinsic
def _node_tile(typing_context, signals, offsets, weights, node, first, rows, row):
    """Fill ``rows[row]``, (part, range) float32, with the beam of a grid point."""
    signature = types.void(signals, offsets, weights, types.intp, types.intp, rows, types.intp)

    def codegen(context, builder, signature, arguments):
        def array(k):
            return context.make_array(signature.args[k])(context, builder, arguments[k])

        dot = Dot32(builder)
        begin = builder.mul(arguments[6], ir.Constant(arguments[6].type, 2 * TILE))
        with dot.passes(begin.type) as ahead:
            dot.add_complex_terms(array(0), array(1), array(2), arguments[3], builder.add(arguments[4], ahead))
            dot.store_parts(builder.gep(array(5).data, [builder.add(begin, ahead)]))
        return context.get_dummy_value()

    return signature, codegen


def _interpolation(n_beams):
    """Return an intrinsic that interpolates one direction, or two that share their grid points."""

    @intrinsic
    def interpolate(typing_context, rows, skipped, places, weights, direction, out, place, next_place):
        """Fill a tile of ``out.flat`` at ``place`` and, of a second direction, at ``next_place``."""
        signature = types.void(rows, types.intp, places, weights, types.intp, out, types.intp, types.intp)

        def codegen(context, builder, signature, arguments):
            def array(k):
                return context.make_array(signature.args[k])(context, builder, arguments[k])

            direction, size = arguments[4], arguments[4].type
            one, length = ir.Constant(size, 1), ir.Constant(size, 2 * TILE)
            n_pairs = cgutils.unpack_tuple(builder, array(2).shape)[1]
            values = builder.bitcast(array(3).data, FLOAT.as_pointer())
            first_pair = builder.mul(direction, n_pairs)
            planes = Planes(builder, n_beams)
            with planes.passes(size) as first:
                with cgutils.for_range(builder, n_pairs) as loop:
                    entry = builder.add(first_pair, loop.index)
                    node = builder.sext(builder.load(builder.gep(array(2).data, [entry])), size)
                    begin = builder.add(builder.mul(builder.sub(node, arguments[1]), length), first)
                    entries = [builder.shl(at, one) for at in (entry, builder.add(entry, n_pairs))][:n_beams]
                    planes.add_real_term(array(0).data, begin, values, entries)
                    entries = [builder.add(at, one) for at in entries]
                    planes.add_real_term(array(0).data, builder.add(begin, length), values, entries)
                for beam in range(n_beams):
                    at = builder.add(arguments[6 + beam], first)
                    planes.store_levels(beam, builder.gep(array(5).data, [at]))
            return context.get_dummy_value()

        return signature, codegen

    return interpolate


_interpolate_one, _interpolate_two = _interpolation(1), _interpolation(2)


@njit(parallel=True, nogil=True, cache=True)
def interpolated_beams_envelope(signals, offsets, weights, places, tap_weights, rows, first, stop, n_blocks, out):
    """Compute beams on a coarse beam grid, interpolate the beams of all directions, and take their envelopes."""
    n_directions, n_ranges = out.shape
    n_tiles = (stop - first + TILE - 1) // TILE
    block = (n_directions + n_blocks - 1) // n_blocks
    same = same_places(places)
    for part in prange(n_tiles * n_blocks):
        # The last tile overlaps the previous one; a tile that is longer than its focal zone begins before the zone.
        at = max(0, min(first + part // n_blocks * TILE, stop - TILE))
        begin = min(part % n_blocks * block, n_directions)
        end = min(begin + block, n_directions)
        if begin == end:
            continue
        lowest, highest = node_span(places, begin, end)
        nodes = np.empty((highest + 1 - lowest, 2, TILE), np.float32)
        for node in range(nodes.shape[0]):
            _node_tile(signals, offsets, weights, lowest + node, at, nodes, node)
        short = np.empty((2, TILE), np.float32)
        direction = begin
        while direction < end:
            two = direction + 1 < end and same[direction]
            after = min(direction + 1, end - 1)
            for k in range(2, 4):
                prefetch_row(out, rows[min(direction + k, end - 1)], at, TILE)
            if at < first or at + TILE > stop:
                if two:
                    _interpolate_two(nodes, lowest, places, tap_weights, direction, short, 0, TILE)
                else:
                    _interpolate_one(nodes, lowest, places, tap_weights, direction, short, 0, 0)
                begin_range, end_range = max(first, at), min(stop, at + TILE)
                for beam in range(2 if two else 1):
                    out[rows[direction + beam], begin_range:end_range] = short[beam, begin_range - at : end_range - at]
            elif two:
                place, next_place = rows[direction] * np.int64(n_ranges) + at, rows[after] * np.int64(n_ranges) + at
                _interpolate_two(nodes, lowest, places, tap_weights, direction, out, place, next_place)
            else:
                place = rows[direction] * np.int64(n_ranges) + at
                _interpolate_one(nodes, lowest, places, tap_weights, direction, out, place, place)
            direction += 2 if two else 1
