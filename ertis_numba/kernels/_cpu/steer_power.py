# mypy: ignore-errors
"""Compute the power that Hermitian matrices have for the wave from each direction."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.vectors import add_product, load, splat, store, subtract_product
from ertis_numba.kernels._cpu.wave_phases import LANES, REGISTERS, begin_phases, move_phases

__all__ = ["steer_power"]

_ZERO, _TWO = np.float32(0), np.float32(2)


@njit(nogil=True, cache=True)
def _pack(matrix, numbers):
    """Fill two rows' coefficients in reading order, 0 left of the diagonal and beyond the last; return the trace."""
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


@njit(nogil=True, cache=True)
def _sum_rows(numbers, n_mics, phases, trace, sums):
    """Fill the powers of a tile: twice the real parts of the upper triangle, plus the trace."""
    total = splat(phases, _ZERO, REGISTERS)
    k = 0
    for i in range(0, n_mics, 2):
        a = splat(phases, _ZERO, REGISTERS)
        b = splat(phases, _ZERO, REGISTERS)
        c = splat(phases, _ZERO, REGISTERS)
        d = splat(phases, _ZERO, REGISTERS)
        for j in range(i + 1, n_mics):
            at = 2 * j * LANES
            real, imag = load(phases, at, REGISTERS), load(phases, at + LANES, REGISTERS)
            x, y = splat(phases, numbers[k], REGISTERS), splat(phases, numbers[k + 1], REGISTERS)
            a = subtract_product(add_product(a, x, real), y, imag)
            b = add_product(add_product(b, x, imag), y, real)
            x, y = splat(phases, numbers[k + 2], REGISTERS), splat(phases, numbers[k + 3], REGISTERS)
            c = subtract_product(add_product(c, x, real), y, imag)
            d = add_product(add_product(d, x, imag), y, real)
            k += 4
        at = 2 * i * LANES
        total = add_product(total, load(phases, at, REGISTERS), a)
        total = add_product(total, load(phases, at + LANES, REGISTERS), b)
        if i + 1 < n_mics:
            at += 2 * LANES
            total = add_product(total, load(phases, at, REGISTERS), c)
            total = add_product(total, load(phases, at + LANES, REGISTERS), d)
    total = add_product(splat(phases, trace, REGISTERS), splat(phases, _TWO, REGISTERS), total)
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
    for tile in prange((n_directions + LANES - 1) // LANES):
        first = tile * LANES
        count = min(LANES, n_directions - first)
        phases = np.empty((n_mics, 2, LANES), np.float32)
        turns = np.empty((n_mics, 2, LANES), np.float32)
        sums = np.empty(LANES, np.float32)
        begin_phases(steps, first, count, np.uint32(1), turns)
        for k in range(n_bins):
            move_phases(steps, first, count, bins, k, turns, phases)
            _sum_rows(numbers[k], n_mics, phases, traces[k], sums)
            for lane in range(count):
                out[k, first + lane] = sums[lane]
