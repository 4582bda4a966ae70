# mypy: ignore-errors
"""Combine the microphones with minimum-variance weights; the method and its equations are those of the CPU kernel.

Each thread handles one window of ranges at a time. Its matrix is in global memory, interleaved with those of the other
threads. The image is split into groups of directions, so that the memory stays within `_MAX_BYTES` for any image.
"""

import math

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._cuda.terms import complexes
from ertis_numba.kernels._scalar import imag_of, real_of

__all__ = ["combine_capon"]

_BLOCK = 64
_MAX_BYTES = 2**25  # for the lags, and the same for the matrices
_MAX_BLOCKS = 65_535  # limit of the last two axes of a grid


@cuda.jit(cache=True)
def _sum_lags(signals, offsets, weights, first, n_mics, beams, lags):
    """Fill ``beams[direction, part, r] = Σ y_r`` and ``lags[direction, lag, part, r] = Σ conj(y_r) y_(r + lag)``."""
    r, lag, direction = np.int64(cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x), cuda.blockIdx.y, cuda.blockIdx.z
    if r + lag >= beams.shape[2]:
        return
    real = imag = beam_real = beam_imag = 0.0
    for mic in range(n_mics):
        entry = (first + direction) * n_mics + mic
        w_real, w_imag = np.float64(real_of(weights[entry])), np.float64(imag_of(weights[entry]))
        x = signals[offsets[entry] + r]
        x_real, x_imag = np.float64(real_of(x)), np.float64(imag_of(x))
        y_real, y_imag = x_real * w_real - x_imag * w_imag, x_real * w_imag + x_imag * w_real
        x = signals[offsets[entry] + r + lag]
        x_real, x_imag = np.float64(real_of(x)), np.float64(imag_of(x))
        z_real, z_imag = x_real * w_real - x_imag * w_imag, x_real * w_imag + x_imag * w_real
        real += y_real * z_real + y_imag * z_imag
        imag += y_real * z_imag - y_imag * z_real
        beam_real += y_real
        beam_imag += y_imag
    lags[direction, lag, 0, r], lags[direction, lag, 1, r] = real, imag
    if lag == 0:
        beams[direction, 0, r], beams[direction, 1, r] = beam_real, beam_imag


@cuda.jit(device=True)
def _factor(lags, direction, first, epsilon, column, thread):
    """Fill the lower triangle of ``column[i, j, part, thread]`` with L D of ``B = L D Lᴴ``; its diagonal is 1 / D."""
    n_snapshots = column.shape[0]
    for j in range(n_snapshots):
        for i in range(j, n_snapshots):  # the conjugate of B_ji, which is lag i − j at sample j
            real = lags[direction, i - j, 0, first + j]
            imag = -lags[direction, i - j, 1, first + j]
            for k in range(j):
                inverse = column[k, k, 0, thread]
                a_real, a_imag = column[i, k, 0, thread], column[i, k, 1, thread]
                b_real, b_imag = column[j, k, 0, thread] * inverse, column[j, k, 1, thread] * inverse
                real -= a_real * b_real + a_imag * b_imag
                imag -= a_imag * b_real - a_real * b_imag
            column[i, j, 0, thread], column[i, j, 1, thread] = real, imag
        column[j, j, 0, thread] = 1.0 / (column[j, j, 0, thread] + epsilon)


@cuda.jit(device=True)
def _solve(beams, direction, first, column, t, thread):
    """Fill ``t[i, part, thread]`` with ``B⁻¹ s`` and return ``sᴴ t``."""
    n_snapshots = column.shape[0]
    fit = 0.0
    for i in range(n_snapshots):  # s is the conjugate of the beams
        real, imag = beams[direction, 0, first + i], -beams[direction, 1, first + i]
        for k in range(i):
            inverse = column[k, k, 0, thread]
            a_real, a_imag = column[i, k, 0, thread] * inverse, column[i, k, 1, thread] * inverse
            b_real, b_imag = t[k, 0, thread], t[k, 1, thread]
            real -= a_real * b_real - a_imag * b_imag
            imag -= a_real * b_imag + a_imag * b_real
        t[i, 0, thread], t[i, 1, thread] = real, imag
        fit += (real * real + imag * imag) * column[i, i, 0, thread]
    for i in range(n_snapshots - 1, -1, -1):
        real, imag = t[i, 0, thread], t[i, 1, thread]
        for k in range(i + 1, n_snapshots):
            a_real, a_imag = column[k, i, 0, thread], column[k, i, 1, thread]
            b_real, b_imag = t[k, 0, thread], t[k, 1, thread]
            real -= a_real * b_real + a_imag * b_imag
            imag -= a_real * b_imag - a_imag * b_real
        inverse = column[i, i, 0, thread]
        t[i, 0, thread], t[i, 1, thread] = real * inverse, imag * inverse
    return fit


@cuda.jit(cache=True)
def _combine(beams, lags, loading, n_mics, column, t, first, n_directions, out):
    n_snapshots = column.shape[0]
    n_windows, middle = out.shape[1] - n_snapshots + 1, n_snapshots // 2
    thread = cuda.grid(1)
    for item in range(thread, n_directions * n_windows, column.shape[3]):
        direction, window = item // n_windows, item % n_windows
        trace = 0.0
        for k in range(window, window + n_snapshots):
            trace += lags[direction, 0, 0, k]
        # Without any power, every loading yields 0.
        epsilon = loading * trace / n_mics if trace != 0.0 else 1.0
        _factor(lags, direction, window, epsilon, column, thread)
        scale = epsilon / (n_mics - _solve(beams, direction, window, column, t, thread))
        # A window yields the range in its middle; the outermost two also yield those towards the ends.
        begin = 0 if window == 0 else middle
        end = n_snapshots if window == n_windows - 1 else middle + 1
        for c in range(begin, end):
            x, y = t[c, 0, thread], t[c, 1, thread]
            out[first + direction, window + c] = np.float32(scale * math.sqrt(x * x + y * y))


def combine_capon(signals, offsets, weights, n_snapshots, loading, out):
    """Combine the microphones with the Capon (minimum-variance distortionless response) weights."""
    (n_directions, n_mics), n_ranges = offsets.shape, out.shape[1]
    n_snapshots = min(n_snapshots, n_ranges)
    of_direction, of_thread = 16 * n_ranges * (n_snapshots + 1), 16 * n_snapshots * (n_snapshots + 1)
    group = max(1, min(_MAX_BYTES // of_direction, n_directions, _MAX_BLOCKS))
    n_windows = group * (n_ranges - n_snapshots + 1)
    n_blocks = -(-min(_MAX_BYTES // of_thread, n_windows) // _BLOCK)
    beams = workspace("capon's beams", (group, 2, n_ranges), np.float64)
    lags = workspace("capon's lags", (group, n_snapshots, 2, n_ranges), np.float64)
    column = workspace("capon's matrices", (n_snapshots, n_snapshots, 2, n_blocks * _BLOCK), np.float64)
    t = workspace("capon's solutions", (n_snapshots, 2, n_blocks * _BLOCK), np.float64)
    tables = complexes(signals), offsets.reshape(-1), complexes(weights)
    for first in range(0, n_directions, group):
        count = min(group, n_directions - first)
        grid = -(-n_ranges // _BLOCK), n_snapshots, count
        launch(_sum_lags, grid, (_BLOCK,), *tables, first, n_mics, beams, lags)
        launch(_combine, (n_blocks,), (_BLOCK,), beams, lags, loading, n_mics, column, t, first, count, out)
