# mypy: ignore-errors
"""Multiply the roots of the microphones' signals with one another, and sum the products.

Roots are computed once per sample and once per weight, because the root of a product is the product of roots.
"""

import math

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._scalar import magnitude

__all__ = ["combine_dmas"]

_ZERO = np.float32(0)  # adding it determines which product is fused
_TILE = 64  # ranges: the sums of order 8 take 4.6 kB
_CHUNK = 4096  # samples


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _take_roots(flat, order, roots):
    exponent = (1 / order - 1) / 2
    for chunk in prange((len(flat) + _CHUNK - 1) // _CHUNK):
        for k in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(flat))):
            # In double precision, the squares of samples neither underflow nor overflow.
            x, y = np.float64(flat[k].real), np.float64(flat[k].imag)
            power = x * x + y * y
            if power == 0:
                scale = 0.0
            elif order == 2:
                scale = 1 / math.sqrt(math.sqrt(power))
            else:
                scale = power**exponent
            roots[0, k], roots[1, k] = scale * x, scale * y


@njit(nogil=True, cache=True, fastmath={"contract"})
def _turn(x_real, x_imag, weight, z):
    """Fill z, (part, range), with the products of x and a weight."""
    for r in range(len(x_real)):
        z[0, r] = (_ZERO + x_real[r] * weight.real) - x_imag[r] * weight.imag
        z[1, r] = (_ZERO + x_real[r] * weight.imag) + x_imag[r] * weight.real


@njit(nogil=True, cache=True, fastmath={"contract"})
def _add_products(z, x, total, count):
    """Add ``z · x`` to ``total``, all (part, range)."""
    for r in range(count):
        total[0, r] = (total[0, r] + z[0, r] * x[0, r]) - z[1, r] * x[1, r]
        total[1, r] = (total[1, r] + z[0, r] * x[1, r]) + z[1, r] * x[0, r]


@njit(parallel=True, nogil=True, cache=True)
def combine_dmas(signals, offsets, weights, order, out):
    """Delay-multiply-and-sum: sum the products of the roots of all combinations of ``order`` microphones."""
    flat = signals.reshape(-1)
    roots = np.empty((2, len(flat)), np.float32)
    _take_roots(flat, order, roots)
    n_directions, n_mics = offsets.shape
    n_ranges = out.shape[1]
    for direction in prange(n_directions):
        z = np.empty((2, _TILE), np.float32)
        for first in range(0, n_ranges, _TILE):
            count = min(_TILE, n_ranges - first)
            # Sums of products of 0, 1, … order of the microphones so far.
            sums = np.zeros((order + 1, 2, _TILE), np.float32)
            sums[0, 0] = 1
            for mic in range(n_mics):
                begin = offsets[direction, mic] + first
                _turn(roots[0, begin : begin + count], roots[1, begin : begin + count], weights[direction, mic], z)
                # From the highest order down, so that no microphone is multiplied with itself.
                for k in range(order, 0, -1):
                    _add_products(z, sums[k - 1], sums[k], count)
            for r in range(count):
                out[direction, first + r] = np.float32(magnitude(sums[order, 0, r], sums[order, 1, r]))
