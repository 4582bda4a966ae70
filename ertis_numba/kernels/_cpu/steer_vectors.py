# mypy: ignore-errors
"""Compute the power that vectors have for the wave from each direction.

Groups of eight microphones are summed first, which reduces rounding errors to about a third.
"""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.vectors import add_product, load, splat, store, subtract_product
from ertis_numba.kernels._cpu.wave_phases import LANES, REGISTERS, begin_phases, move_phases

__all__ = ["steer_vectors"]

_SUMMED = 8  # microphones
_ZERO = np.float32(0)


@njit(nogil=True, cache=True)
def _pack(vectors, numbers):
    """Fill the coefficients of two vectors, in the order in which they are read; those beyond the last are 0."""
    n_vectors, n_mics = vectors.shape
    k = 0
    for i in range(0, n_vectors, 2):
        for mic in range(n_mics):
            numbers[k], numbers[k + 1] = vectors[i, mic].real, vectors[i, mic].imag
            both = i + 1 < n_vectors
            numbers[k + 2] = vectors[i + 1, mic].real if both else _ZERO
            numbers[k + 3] = vectors[i + 1, mic].imag if both else _ZERO
            k += 4


@njit(nogil=True, cache=True)
def _sum_pair(numbers, k, n_mics, phases, total):
    """Return ``total`` plus the powers of two vectors, whose coefficients begin at ``k``."""
    a = splat(phases, _ZERO, REGISTERS)
    b = splat(phases, _ZERO, REGISTERS)
    c = splat(phases, _ZERO, REGISTERS)
    d = splat(phases, _ZERO, REGISTERS)
    for first in range(0, n_mics, _SUMMED):
        e = splat(phases, _ZERO, REGISTERS)
        f = splat(phases, _ZERO, REGISTERS)
        g = splat(phases, _ZERO, REGISTERS)
        h = splat(phases, _ZERO, REGISTERS)
        for mic in range(first, min(first + _SUMMED, n_mics)):
            at = 2 * mic * LANES
            real, imag = load(phases, at, REGISTERS), load(phases, at + LANES, REGISTERS)
            x, y = splat(phases, numbers[k], REGISTERS), splat(phases, numbers[k + 1], REGISTERS)
            e = add_product(add_product(e, x, real), y, imag)
            f = subtract_product(add_product(f, x, imag), y, real)
            x, y = splat(phases, numbers[k + 2], REGISTERS), splat(phases, numbers[k + 3], REGISTERS)
            g = add_product(add_product(g, x, real), y, imag)
            h = subtract_product(add_product(h, x, imag), y, real)
            k += 4
        a, b, c, d = a + e, b + f, c + g, d + h
    total = add_product(add_product(total, a, a), b, b)
    return add_product(add_product(total, c, c), d, d)


@njit(nogil=True, cache=True)
def _sum_vectors(numbers, n_mics, phases, sums):
    """Fill the powers of a tile."""
    total = splat(phases, _ZERO, REGISTERS)
    for k in range(0, len(numbers), 4 * n_mics):
        total = _sum_pair(numbers, k, n_mics, phases, total)
    store(total, sums, 0)


@njit(parallel=True, nogil=True, cache=True)
def steer_vectors(vectors, steps, bins, out):
    """Compute the power that vectors have for the wave from each direction."""
    n_bins, n_vectors, n_mics = vectors.shape
    n_directions = steps.shape[1]
    numbers = np.empty((n_bins, 4 * n_mics * ((n_vectors + 1) // 2)), np.float32)
    for k in prange(n_bins):
        _pack(vectors[k], numbers[k])
    for tile in prange((n_directions + LANES - 1) // LANES):
        first = tile * LANES
        count = min(LANES, n_directions - first)
        phases = np.empty((n_mics, 2, LANES), np.float32)
        turns = np.empty((n_mics, 2, LANES), np.float32)
        sums = np.empty(LANES, np.float32)
        begin_phases(steps, first, count, np.uint32(1), turns)
        for k in range(n_bins):
            move_phases(steps, first, count, bins, k, turns, phases)
            _sum_vectors(numbers[k], n_mics, phases, sums)
            for lane in range(count):
                out[k, first + lane] = sums[lane]
