# mypy: ignore-errors
"""Compute the power that Hermitian matrices have for the wave from each direction.

A tile of directions keeps its phases in the first cache. Two rows of a matrix at a time accumulate their sums in
registers, so that each phase is read for two rows. From bin to bin, a complex product turns the phases, which are
computed anew every few bins, so that rounding errors remain below 2e-6.
"""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.vectors import REGISTER_BYTES, add_product, load, splat, store, subtract_product
from ertis_numba.kernels._scalar import cosine_and_sine

__all__ = ["steer_power"]

_REGISTERS = 2
_LANES = _REGISTERS * REGISTER_BYTES // 4  # directions of a tile
_TURNED = 16  # bins from one cosine to the next
_ZERO, _TWO = np.float32(0), np.float32(2)


@njit(nogil=True, cache=True)
def _pack(matrix, numbers):
    """Fill the coefficients of two rows, in the order in which they are read, and return the trace.

    Those left of the diagonal and those of a row beyond the last are 0.
    """
    n_mics, k, trace = len(matrix), 0, _ZERO
    for i in range(n_mics):
        trace += matrix[i, i].real
    for i in range(0, n_mics, 2):
        for j in range(i + 1, n_mics):
            numbers[k], numbers[k + 1] = matrix[i, j].real, matrix[i, j].imag
            lower = j > i + 1
            numbers[k + 2] = matrix[i + 1, j].real if lower else _ZERO
            numbers[k + 3] = matrix[i + 1, j].imag if lower else _ZERO
            k += 4
    return trace


@njit(nogil=True, cache=True, fastmath={"contract"})
def _begin(steps, first, count, number, phases):
    """Fill (mic, part, lane) with the phases of a tile at a bin."""
    for mic in range(steps.shape[0]):
        for lane in range(_LANES):
            step = steps[mic, first + min(lane, count - 1)]
            real, imag = cosine_and_sine(np.uint32(np.uint64(step) * np.uint64(number)))
            phases[mic, 0, lane], phases[mic, 1, lane] = real, -imag


@njit(nogil=True, cache=True)
def _turn(phases, turns):
    for place in range(0, phases.size, 2 * _LANES):
        a, b = load(phases, place, _REGISTERS), load(phases, place + _LANES, _REGISTERS)
        c, d = load(turns, place, _REGISTERS), load(turns, place + _LANES, _REGISTERS)
        store(subtract_product(a * c, b, d), phases, place)
        store(add_product(a * d, b, c), phases, place + _LANES)


@njit(nogil=True, cache=True)
def _sum_rows(numbers, n_mics, phases, trace, sums):
    """Fill the powers of a tile: twice the real parts of the upper triangle, plus the trace."""
    total = splat(phases, _ZERO, _REGISTERS)
    k = 0
    for i in range(0, n_mics, 2):
        a = splat(phases, _ZERO, _REGISTERS)
        b = splat(phases, _ZERO, _REGISTERS)
        c = splat(phases, _ZERO, _REGISTERS)
        d = splat(phases, _ZERO, _REGISTERS)
        for j in range(i + 1, n_mics):
            at = 2 * j * _LANES
            real, imag = load(phases, at, _REGISTERS), load(phases, at + _LANES, _REGISTERS)
            x, y = splat(phases, numbers[k], _REGISTERS), splat(phases, numbers[k + 1], _REGISTERS)
            a = subtract_product(add_product(a, x, real), y, imag)
            b = add_product(add_product(b, x, imag), y, real)
            x, y = splat(phases, numbers[k + 2], _REGISTERS), splat(phases, numbers[k + 3], _REGISTERS)
            c = subtract_product(add_product(c, x, real), y, imag)
            d = add_product(add_product(d, x, imag), y, real)
            k += 4
        at = 2 * i * _LANES
        total = add_product(total, load(phases, at, _REGISTERS), a)
        total = add_product(total, load(phases, at + _LANES, _REGISTERS), b)
        if i + 1 < n_mics:
            at += 2 * _LANES
            total = add_product(total, load(phases, at, _REGISTERS), c)
            total = add_product(total, load(phases, at + _LANES, _REGISTERS), d)
    total = add_product(splat(phases, trace, _REGISTERS), splat(phases, _TWO, _REGISTERS), total)
    store(total, sums, 0)


@njit(parallel=True, nogil=True, cache=True)
def steer_power(matrices, steps, bins, out):
    """Compute the power that Hermitian matrices have for the wave from each direction."""
    n_bins, n_mics, _ = matrices.shape
    n_directions = steps.shape[1]
    numbers = np.empty((n_bins, 2 * n_mics * (n_mics + 1)), np.float32)
    traces = np.empty(n_bins, np.float32)
    for k in prange(n_bins):
        traces[k] = _pack(matrices[k], numbers[k])
    for tile in prange((n_directions + _LANES - 1) // _LANES):
        first = tile * _LANES
        count = min(_LANES, n_directions - first)
        phases = np.empty((n_mics, 2, _LANES), np.float32)
        turns = np.empty((n_mics, 2, _LANES), np.float32)
        sums = np.empty(_LANES, np.float32)
        _begin(steps, first, count, np.uint32(1), turns)
        for k in range(n_bins):
            if k % _TURNED == 0 or bins[k] != bins[k - 1] + np.uint32(1):
                _begin(steps, first, count, bins[k], phases)
            else:
                _turn(phases, turns)
            _sum_rows(numbers[k], n_mics, phases, traces[k], sums)
            for lane in range(count):
                out[k, first + lane] = sums[lane]
