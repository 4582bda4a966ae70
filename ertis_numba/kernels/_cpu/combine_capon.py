# mypy: ignore-errors
"""Combine the microphones with minimum-variance weights, from covariances over a window of ranges.

docs/explanation/beamformers.md has the K × K system of a window of K ranges. Its products ``Yᴴ Y`` are of the same
signals at lags up to K − 1, which neighbouring windows share. Each lane of a vector holds one window.
"""

import math

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.unrolled import solve_unrolled
from ertis_numba.kernels._cpu.vectors import (
    REGISTER_BYTES,
    add_product,
    load,
    splat,
    store,
    subtract_product,
    where_zero,
)

__all__ = ["combine_capon"]

_ROWS = 64  # ranges of a tile: the signals of so few stay in the L2 cache
_GROUP = 4  # lags whose sums stay in registers
_FEW = 16  # directions per block at least, because each block reads the signals of a tile again
_BLOCK = 256  # directions whose delays and weights (98 kB at 32 microphones) share the cache with the signals of a tile
_BEYOND = (
    64  # samples that are read beyond a tile, at most: lags up to those of the last group, and the rest of a vector
)
_PAIR = 2  # registers of each vector of equations: work on one fills the wait for the other
_USUAL = 5  # snapshots: the default, whose equations are compiled without loops


@njit(nogil=True, cache=True)
def _largest_exponent(bits):
    """Return the exponent of the largest finite float32 number; the numbers are given as uint32."""
    largest = np.uint32(0)
    for k in range(len(bits)):
        exponent = (bits[k] >> np.uint32(23)) & np.uint32(255)
        largest = max(largest, exponent if exponent != np.uint32(255) else np.uint32(0))
    return np.int64(largest) - 127


@njit(parallel=True, nogil=True, cache=True)
def _separate(flat, scale, planes):
    """Fill ``planes``, (part, sample), with scaled real and imaginary parts, and with zeros beyond the signals."""
    n, width = len(flat), planes.shape[1]
    for part in prange(-(-width // 4096)):
        begin, end = part * 4096, min((part + 1) * 4096, width)
        for k in range(begin, min(n, end)):
            planes[0, k], planes[1, k] = flat[k].real * scale, flat[k].imag * scale
        for k in range(max(n, begin), end):
            planes[0, k] = planes[1, k] = 0


@njit(inline="always")
def _add_lag(real, imag, u, v, planes, at, plane):
    """Return the sums with ``conj(u + iv) · x`` added."""
    x, y = load(planes, at, 1), load(planes, plane + at, 1)
    return add_product(add_product(real, u, x), v, y), subtract_product(add_product(imag, u, y), v, x)


@njit(inline="always")
def _store(real, imag, lags, place, width):
    store(real, lags, place)
    store(imag, lags, place + width)


@njit(nogil=True, cache=True)
def _sum_products(planes, offsets, weights, first, width, group, beams, lags):
    """Fill ``lags[lag, part, r] = Σ_mic conj(y_r) y_(r + lag)`` of a group of lags, for all ranges of a tile.

    The first group also fills ``lags[0, 0, r] = Σ_mic |y_r|²`` and ``beams[part, r] = Σ_mic y_r``. Weights have columns
    re w, im w and |w|².
    """
    imag, zero, lag = planes.shape[1], splat(planes, 0.0, 1), 1 + _GROUP * group
    for row in range(0, _ROWS, REGISTER_BYTES // planes.itemsize):
        a_real = a_imag = b_real = b_imag = c_real = c_imag = d_real = d_imag = zero
        s_real = s_imag = total = zero
        for mic in range(len(offsets)):
            at = offsets[mic] + first + row
            x, y, square = load(planes, at, 1), load(planes, imag + at, 1), splat(planes, weights[mic, 2], 1)
            u, v = x * square, y * square
            if group == 0:
                w_real, w_imag = splat(planes, weights[mic, 0], 1), splat(planes, weights[mic, 1], 1)
                s_real = subtract_product(add_product(s_real, x, w_real), y, w_imag)
                s_imag = add_product(add_product(s_imag, x, w_imag), y, w_real)
                total = add_product(add_product(total, u, x), v, y)
            a_real, a_imag = _add_lag(a_real, a_imag, u, v, planes, at + lag, imag)
            b_real, b_imag = _add_lag(b_real, b_imag, u, v, planes, at + lag + 1, imag)
            c_real, c_imag = _add_lag(c_real, c_imag, u, v, planes, at + lag + 2, imag)
            d_real, d_imag = _add_lag(d_real, d_imag, u, v, planes, at + lag + 3, imag)
        place = 2 * lag * width + row
        _store(a_real, a_imag, lags, place, width)
        _store(b_real, b_imag, lags, place + 2 * width, width)
        _store(c_real, c_imag, lags, place + 4 * width, width)
        _store(d_real, d_imag, lags, place + 6 * width, width)
        if group == 0:
            store(total, lags, row)
            _store(s_real, s_imag, beams, row, width)


@njit(nogil=True, cache=True)
def _subtract_mean(beams, n_mics, n_snapshots, width, power, lags):
    """Move the powers from ``lags`` to ``power``, and subtract the products of the mean over microphones."""
    share = splat(lags, 1.0 / n_mics, 1)
    for row in range(0, _ROWS, REGISTER_BYTES // lags.itemsize):
        s_real, s_imag = load(beams, row, 1) * share, load(beams, width + row, 1) * share
        store(load(lags, row, 1), power, row)
        for lag in range(n_snapshots):
            place = 2 * lag * width + row
            x, y = load(beams, row + lag, 1), load(beams, width + row + lag, 1)
            real, imag = load(lags, place, 1), load(lags, place + width, 1)
            real = subtract_product(subtract_product(real, s_real, x), s_imag, y)
            imag = add_product(subtract_product(imag, s_real, y), s_imag, x)
            _store(real, imag, lags, place, width)


@njit(nogil=True, cache=True)
def _solve(beams, power, lags, width, begin, end, centre, n_snapshots, loading, matrix, levels):
    """Set the levels at range ``centre`` of windows, by elimination with the centre last: ``ε I + D = L D Lᴴ``."""
    lanes = _PAIR * REGISTER_BYTES // lags.itemsize
    one, scaled = splat(lags, 1.0, _PAIR), n_snapshots * n_snapshots * 2 * lanes
    for first in range(begin, end, lanes):
        epsilon = splat(lags, 0.0, _PAIR)
        for k in range(n_snapshots):
            epsilon = epsilon + load(power, first + k, _PAIR)
        # Without any power, every loading yields 0.
        epsilon = where_zero(epsilon * splat(lags, loading, _PAIR), one)
        for j in range(n_snapshots):
            p = j + (j >= centre) if j < n_snapshots - 1 else centre
            real, imag = load(beams, first + p, _PAIR), load(beams, width + first + p, _PAIR)
            for k in range(j):
                a, b, c = 2 * lanes * (j * n_snapshots + k), 2 * lanes * (k * n_snapshots + k), scaled + 2 * lanes * k
                inverse = load(matrix, scaled + 2 * lanes * (n_snapshots + k), _PAIR)
                a_real, a_imag = load(matrix, a, _PAIR) * inverse, load(matrix, a + lanes, _PAIR) * inverse
                _store(a_real, a_imag, matrix, c, lanes)
                b_real, b_imag = load(matrix, b, _PAIR), load(matrix, b + lanes, _PAIR)
                real = add_product(subtract_product(real, a_real, b_real), a_imag, b_imag)
                imag = subtract_product(subtract_product(imag, a_real, b_imag), a_imag, b_real)
            _store(real, imag, matrix, 2 * lanes * (j * n_snapshots + j), lanes)
            for i in range(j, n_snapshots):
                q = i + (i >= centre) if i < n_snapshots - 1 else centre
                at = 2 * abs(q - p) * width + first + min(p, q)
                real, imag = load(lags, at, _PAIR), load(lags, width + at, _PAIR)
                if q < p:
                    imag = splat(lags, 0.0, _PAIR) - imag
                for k in range(j):
                    a, b = 2 * lanes * (i * n_snapshots + k), scaled + 2 * lanes * k
                    a_real, a_imag = load(matrix, a, _PAIR), load(matrix, a + lanes, _PAIR)
                    b_real, b_imag = load(matrix, b, _PAIR), load(matrix, b + lanes, _PAIR)
                    real = subtract_product(subtract_product(real, a_real, b_real), a_imag, b_imag)
                    imag = add_product(subtract_product(imag, a_imag, b_real), a_real, b_imag)
                if i == j:
                    store(one / (real + epsilon), matrix, scaled + 2 * lanes * (n_snapshots + j))
                else:
                    _store(real, imag, matrix, 2 * lanes * (i * n_snapshots + j), lanes)
        last = n_snapshots - 1
        scale = epsilon * load(matrix, scaled + 2 * lanes * (n_snapshots + last), _PAIR)
        at = 2 * lanes * (last * n_snapshots + last)
        _store(load(matrix, at, _PAIR) * scale, load(matrix, at + lanes, _PAIR) * scale, levels, first - begin, width)


@njit(nogil=True, cache=True)
def _solve_usual(beams, power, lags, width, count, loading, levels):
    for first in range(0, count, REGISTER_BYTES // lags.itemsize):
        solve_unrolled(beams, power, lags, width, first, loading, levels, first, _USUAL)


@njit(nogil=True, cache=True)
def _write(levels, width, count, unit, out):
    for k in range(count):
        x, y = levels[k], levels[width + k]
        out[k] = unit * math.sqrt(x * x + y * y)


@njit(parallel=True, nogil=True, cache=True)
def _combine(planes, offsets, table, n_snapshots, loading, unit, out):
    n_directions, n_ranges = out.shape
    n_mics = offsets.shape[1]
    n_windows, middle = n_ranges - n_snapshots + 1, n_snapshots // 2
    n_groups = max(1, (n_snapshots + _GROUP - 2) // _GROUP)
    tile = _ROWS - n_snapshots + 1
    n_tiles = (n_windows + tile - 1) // tile
    # Small images get smaller blocks, so that every thread gets some.
    block = min(_BLOCK, max(_FEW, n_directions * n_tiles // 64))
    n_blocks = (n_directions + block - 1) // block
    lanes = _PAIR * REGISTER_BYTES // planes.itemsize
    width = _ROWS + lanes + _GROUP * n_groups
    for part in prange(n_tiles * n_blocks):
        first, begin = part // n_blocks * tile, part % n_blocks * block
        count = min(tile, n_windows - first)
        beams, power = np.zeros(2 * width, planes.dtype), np.zeros(width, planes.dtype)
        lags = np.zeros((1 + _GROUP * n_groups) * 2 * width, planes.dtype)
        matrix = np.empty((n_snapshots + 2) * n_snapshots * 2 * lanes, planes.dtype)
        levels = np.empty(2 * width, planes.dtype)
        for direction in range(begin, min(begin + block, n_directions)):
            row = out[direction]
            for group in range(n_groups):
                _sum_products(planes, offsets[direction], table[direction], first, width, group, beams, lags)
            _subtract_mean(beams, n_mics, n_snapshots, width, power, lags)
            if n_snapshots == _USUAL:
                _solve_usual(beams, power, lags, width, count, loading, levels)
            else:
                _solve(beams, power, lags, width, 0, count, middle, n_snapshots, loading, matrix, levels)
            _write(levels, width, count, unit, row[first + middle :])
            # The outermost windows also yield the ranges towards the ends.
            if first == 0:
                for k in range(middle):
                    _solve(beams, power, lags, width, 0, 1, k, n_snapshots, loading, matrix, levels)
                    _write(levels, width, 1, unit, row[k:])
            if first + count == n_windows:
                for k in range(middle + 1, n_snapshots):
                    last = count - 1
                    _solve(beams, power, lags, width, last, count, k, n_snapshots, loading, matrix, levels)
                    _write(levels, width, 1, unit, row[first + last + k :])


def combine_capon(signals, offsets, weights, n_snapshots, loading, out):
    """Combine the microphones with the Capon (minimum-variance distortionless response) weights."""
    flat, n_mics = signals.reshape(-1), offsets.shape[1]
    n_snapshots = min(n_snapshots, out.shape[1])
    real = np.float32 if weights.dtype == np.complex64 else np.float64
    unit = math.ldexp(1.0, _largest_exponent(flat.view(np.uint32)))
    planes = np.empty((2, len(flat) + _ROWS + _BEYOND), real)
    _separate(flat, real(1 / unit), planes)
    table = np.stack([weights.real, weights.imag, weights.real**2 + weights.imag**2], axis=2)
    _combine(planes, offsets, table, n_snapshots, real(loading / n_mics), real(unit / n_mics), out)
