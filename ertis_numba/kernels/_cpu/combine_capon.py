# mypy: ignore-errors
"""Combine the microphones with minimum-variance weights, from covariances over a window of ranges.

A window of K ranges has a covariance of rank K. By the Woodbury identity, its loaded inverse needs only a K × K system.
Let Y, (mic, K), be the window's samples, ``G = Yᴴ Y`` their Gram matrix, ``s = Yᴴ 1`` their beams, and
``B = ε I + G``. The solution t of ``B t = s`` yields the output ``ε |t_c| / (M − sᴴ t)`` at range c of the window. G
contains products of the same signals at lags up to K − 1, which neighbouring windows share.

Sums are in double precision. If the microphones agree, ``M − sᴴ t`` is smaller than M by a factor of M / loading, and
it is the denominator.
"""

import math

import numpy as np
from numba import njit, prange

__all__ = ["combine_capon"]

_LANES = 32  # windows that are solved in parallel


@njit(nogil=True, cache=True, fastmath={"contract"})
def _sum_lags(flat, offsets, weights, y, beams, lags):
    """Fill ``beams[part, r] = Σ_mic y_r`` and ``lags[lag, part, r] = Σ_mic conj(y_r) y_(r + lag)``."""
    n_snapshots, _, n_ranges = lags.shape
    beams[:] = 0
    lags[:] = 0
    y_real, y_imag = y[0], y[1]
    for mic in range(len(offsets)):
        delayed = flat[offsets[mic] : offsets[mic] + n_ranges]
        w_real, w_imag = np.float64(weights[mic].real), np.float64(weights[mic].imag)
        for r in range(n_ranges):
            x_real, x_imag = np.float64(delayed[r].real), np.float64(delayed[r].imag)
            y_real[r] = (0.0 + x_real * w_real) - x_imag * w_imag
            y_imag[r] = (0.0 + x_real * w_imag) + x_imag * w_real
        for r in range(n_ranges):
            beams[0, r] += y_real[r]
            beams[1, r] += y_imag[r]
        for lag in range(n_snapshots):
            real, imag = lags[lag, 0], lags[lag, 1]
            for r in range(n_ranges - lag):
                real[r] = (real[r] + y_real[r] * y_real[r + lag]) + y_imag[r] * y_imag[r + lag]
                imag[r] = (imag[r] + y_real[r] * y_imag[r + lag]) - y_imag[r] * y_real[r + lag]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})
def _factor(lags, first, count, epsilon, column):
    """Fill the lower triangle of ``column``, (K, K, part, lane), with L D of ``B = L D Lᴴ``; its diagonal is 1 / D.

    B is Hermitian and, due to its loading, positive definite. Pivoting is not needed.
    """
    n_snapshots = len(lags)
    for j in range(n_snapshots):
        row = first + j
        for i in range(j, n_snapshots):
            for lane in range(count):  # the conjugate of B_ji, which is lag i − j at sample j
                column[i, j, 0, lane] = lags[i - j, 0, row + lane]
                column[i, j, 1, lane] = -lags[i - j, 1, row + lane]
            for k in range(j):
                for lane in range(count):
                    inverse = column[k, k, 0, lane]
                    a_real, a_imag = column[i, k, 0, lane], column[i, k, 1, lane]
                    b_real, b_imag = column[j, k, 0, lane] * inverse, column[j, k, 1, lane] * inverse
                    column[i, j, 0, lane] = (column[i, j, 0, lane] - a_real * b_real) - a_imag * b_imag
                    column[i, j, 1, lane] = (column[i, j, 1, lane] - a_imag * b_real) + a_real * b_imag
        for lane in range(count):
            column[j, j, 0, lane] = 1 / (column[j, j, 0, lane] + epsilon[lane])


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})
def _solve(beams, first, count, column, t, fit):
    """Fill ``t = B⁻¹ s``, (K, part, lane), and ``fit = sᴴ t``, from the result of `_factor`."""
    n_snapshots = len(t)
    fit[:count] = 0
    for i in range(n_snapshots):
        for lane in range(count):  # s is the conjugate of the beams
            t[i, 0, lane] = beams[0, first + i + lane]
            t[i, 1, lane] = -beams[1, first + i + lane]
        for k in range(i):
            for lane in range(count):
                inverse = column[k, k, 0, lane]
                a_real, a_imag = column[i, k, 0, lane] * inverse, column[i, k, 1, lane] * inverse
                b_real, b_imag = t[k, 0, lane], t[k, 1, lane]
                t[i, 0, lane] = (t[i, 0, lane] - a_real * b_real) + a_imag * b_imag
                t[i, 1, lane] = (t[i, 1, lane] - a_real * b_imag) - a_imag * b_real
        for lane in range(count):
            real, imag = t[i, 0, lane], t[i, 1, lane]
            fit[lane] += ((0.0 + real * real) + imag * imag) * column[i, i, 0, lane]
    for i in range(n_snapshots - 1, -1, -1):
        for k in range(i + 1, n_snapshots):
            for lane in range(count):
                a_real, a_imag = column[k, i, 0, lane], column[k, i, 1, lane]
                b_real, b_imag = t[k, 0, lane], t[k, 1, lane]
                t[i, 0, lane] = (t[i, 0, lane] - a_real * b_real) - a_imag * b_imag
                t[i, 1, lane] = (t[i, 1, lane] - a_real * b_imag) + a_imag * b_real
        for lane in range(count):
            inverse = column[i, i, 0, lane]
            t[i, 0, lane] *= inverse
            t[i, 1, lane] *= inverse


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def combine_capon(signals, offsets, weights, n_snapshots, loading, out):
    """Combine the microphones with the Capon (minimum-variance distortionless response) weights."""
    flat = signals.reshape(-1)
    n_directions, n_mics = offsets.shape
    n_ranges = out.shape[1]
    n_snapshots = min(n_snapshots, n_ranges)
    n_windows, middle = n_ranges - n_snapshots + 1, n_snapshots // 2
    for direction in prange(n_directions):
        y, beams = np.empty((2, n_ranges), np.float64), np.empty((2, n_ranges), np.float64)
        lags = np.empty((n_snapshots, 2, n_ranges), np.float64)
        column = np.empty((n_snapshots, n_snapshots, 2, _LANES), np.float64)
        t = np.empty((n_snapshots, 2, _LANES), np.float64)
        epsilon, fit = np.empty(_LANES, np.float64), np.empty(_LANES, np.float64)
        _sum_lags(flat, offsets[direction], weights[direction], y, beams, lags)
        for first in range(0, n_windows, _LANES):
            count = min(_LANES, n_windows - first)
            for lane in range(count):
                trace = 0.0
                for k in range(first + lane, first + lane + n_snapshots):
                    trace += lags[0, 0, k]
                # Without any power, every loading yields 0.
                epsilon[lane] = loading * trace / n_mics if trace != 0 else 1.0
            _factor(lags, first, count, epsilon, column)
            _solve(beams, first, count, column, t, fit)
            for lane in range(count):
                window = first + lane
                # A window yields the range in its middle; the outermost two also yield those towards the ends.
                begin = 0 if window == 0 else middle
                end = n_snapshots if window == n_windows - 1 else middle + 1
                scale = epsilon[lane] / (n_mics - fit[lane])
                for c in range(begin, end):
                    x, z = t[c, 0, lane], t[c, 1, lane]
                    out[direction, window + c] = np.float32(scale * math.sqrt(x * x + z * z))
