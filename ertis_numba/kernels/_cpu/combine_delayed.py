# mypy: ignore-errors
"""Combine the delayed real signals of all microphones: sums, or sums of products, with or without coherence factor."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.vectors import REGISTER_BYTES, add_product, load, splat, store, where_zero

__all__ = ["combine_delayed"]

_SUMMED, _MULTIPLIED = 4, 2  # registers at a time: enough chains of additions, and no more registers than there are
_LANES = REGISTER_BYTES // 4
_MAX_ORDER = 5
_DIRECTIONS = 16  # directions per block
_TILE_NUMBERS = 8_192  # samples of all microphones in a tile, which fits into an L1 cache


@njit(nogil=True, cache=True)
def _sum(signals, starts, place, out, target):
    """Write the sums of one vector of samples."""
    total = load(signals, starts[0] + place, _SUMMED)
    for mic in range(1, len(starts)):
        total = total + load(signals, starts[mic] + place, _SUMMED)
    store(total, out, target)


@njit(nogil=True, cache=True)
def _sum_products(roots, starts, place, order, out, target):
    """Write the elementary symmetric polynomials of one vector of samples."""
    zero = splat(roots, 0, _MULTIPLIED)
    one, two, three, four, five = zero, zero, zero, zero, zero
    for mic in range(len(starts)):
        root = load(roots, starts[mic] + place, _MULTIPLIED)
        if order > 4:
            five = add_product(five, four, root)
        if order > 3:
            four = add_product(four, three, root)
        if order > 2:
            three = add_product(three, two, root)
        two = add_product(two, one, root)
        one = one + root
    store(two if order == 2 else three if order == 3 else four if order == 4 else five, out, target)


@njit(nogil=True, cache=True)
def _weight(signals, starts, place, out, target):
    """Multiply one vector of samples by the coherence factor."""
    total, power = splat(signals, 0, _MULTIPLIED), splat(signals, 0, _MULTIPLIED)
    for mic in range(len(starts)):
        x = load(signals, starts[mic] + place, _MULTIPLIED)
        total = total + x
        power = add_product(power, x, x)
    power = where_zero(power, splat(signals, 1, _MULTIPLIED))  # The total is 0 there as well.
    factor = total * total / (power * splat(signals, len(starts), _MULTIPLIED))
    store(load(out, target, _MULTIPLIED) * factor, out, target)


@njit(nogil=True, cache=True)
def _combine_short(signals, roots, starts, order, coherent, out):
    """Fill a row that is shorter than a vector."""
    sums = np.empty(_MAX_ORDER + 1, np.float32)
    for n in range(len(out)):
        total = power = np.float32(0)
        sums[:] = 0
        sums[0] = 1
        for mic in range(len(starts)):
            x = signals.flat[starts[mic] + n]
            total += x
            power += x * x
            for k in range(order, 0, -1):
                sums[k] += sums[k - 1] * roots.flat[starts[mic] + n]
        out[n] = total if order == 1 else sums[order]
        if coherent:
            out[n] *= total * total / (np.float32(len(starts)) * power) if power > 0 else np.float32(0)


@njit(nogil=True, cache=True)
def _combine_tile(signals, roots, starts, order, low, high, out, direction):
    """Write the samples from ``low`` to ``high`` of a direction; the last vector computes some samples again."""
    n_samples = out.shape[1]
    width = (_SUMMED if order == 1 else _MULTIPLIED) * _LANES
    row = direction * n_samples
    for begin in range(low, high, width):
        place = min(begin, n_samples - width)
        if order == 1:
            _sum(signals, starts, place, out, row + place)
        else:
            _sum_products(roots, starts, place, order, out, row + place)


@njit(nogil=True, cache=True)
def _weight_row(signals, starts, out, direction):
    """Multiply all samples of a direction by the coherence factor."""
    n_mics, n_samples = len(starts), out.shape[1]
    width = _MULTIPLIED * _LANES
    n_whole = n_samples // width * width
    for place in range(0, n_whole, width):
        _weight(signals, starts, place, out, direction * n_samples + place)
    for n in range(n_whole, n_samples):
        total = power = np.float32(0)
        for mic in range(n_mics):
            x = signals.flat[starts[mic] + n]
            total += x
            power += x * x
        out[direction, n] *= total * total / (np.float32(n_mics) * power) if power > 0 else np.float32(0)


@njit(parallel=True, nogil=True, cache=True)
def combine_delayed(signals, roots, delays, order, coherent, first, out):
    """Combine the delayed real signals of all microphones for every direction and sample."""
    n_directions, n_mics = delays.shape
    n_samples, stride = out.shape[1], signals.shape[1]
    width = (_SUMMED if order == 1 else _MULTIPLIED) * _LANES
    tile = max(width, _TILE_NUMBERS // n_mics // width * width)
    for block in prange((n_directions + _DIRECTIONS - 1) // _DIRECTIONS):
        begin, end = block * _DIRECTIONS, min((block + 1) * _DIRECTIONS, n_directions)
        starts = np.empty((end - begin, n_mics), np.int64)
        for direction in range(begin, end):
            for mic in range(n_mics):
                starts[direction - begin, mic] = mic * stride + first + delays[direction, mic]
        if n_samples < _SUMMED * _LANES:
            for direction in range(begin, end):
                _combine_short(signals, roots, starts[direction - begin], order, coherent, out[direction])
            continue
        # All directions of a block use one tile of the signals, which the cache holds, before the next.
        for low in range(0, n_samples, tile):
            high = min(low + tile, n_samples)
            for direction in range(begin, end):
                _combine_tile(signals, roots, starts[direction - begin], order, low, high, out, direction)
        if coherent:
            for direction in range(begin, end):
                _weight_row(signals, starts[direction - begin], out, direction)
