# mypy: ignore-errors
"""Combine the microphones with minimum-variance weights; the method and its equations are those of the CPU kernel.

Each thread handles one window of ranges at a time, with its matrix in interleaved global memory of `_MAX_BYTES`.
"""

import math

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import complexes
from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._scalar import imag_of, real_of

__all__ = ["combine_capon"]

_BLOCK = 64
_MAX_BYTES = 2**25  # for the lags, and the same for the matrices
_MAX_BLOCKS = 65_535  # limit of the last two axes of a grid
_NUMBERS = 32  # per thread that seeks the largest
_23, _EXPONENT, _BIAS = np.uint32(23), np.uint32(255), np.int32(127)
_LARGEST = np.int32(126)  # exponent whose inverse is the smallest normal number
_ZERO, _ONE = np.float32(0), np.float32(1)


@cuda.jit(cache=True)
def _clear(exponent):
    exponent[0] = -_LARGEST


@cuda.jit(cache=True)
def _find_exponent(bits, exponent):
    """Set ``exponent[0]`` to that of the largest finite number, given as uint32."""
    largest = -_LARGEST
    for k in range(cuda.grid(1), bits.size, cuda.gridsize(1)):
        found = (bits[k] >> _23) & _EXPONENT
        if found != _EXPONENT:
            largest = max(largest, np.int32(found) - _BIAS)
    cuda.atomic.max(exponent, 0, min(largest, _LARGEST))


@cuda.jit(device=True)
def _scale_of(exponent):
    """Return 2 to the power of ``exponent``, from -126 to 126, as a float32."""
    return np.uint32((exponent + _BIAS) << np.int32(23)).view(np.float32)


@cuda.jit(cache=True)
def _sum_lags(signals, offsets, weights, exponent, first, n_mics, beams, lags):
    """Fill ``beams[direction, part, r] = Σ y_r`` and ``lags[direction, lag, part, r] = Σ conj(y_r) y_(r + lag)``."""
    r, lag, direction = np.int64(cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x), cuda.blockIdx.y, cuda.blockIdx.z
    if r + lag >= beams.shape[2]:
        return
    scale = _scale_of(-exponent[0])
    real = imag = beam_real = beam_imag = _ZERO
    for mic in range(n_mics):
        entry = (first + direction) * n_mics + mic
        w_real, w_imag = weights[2 * entry], weights[2 * entry + 1]
        square = w_real * w_real + w_imag * w_imag
        x, z = signals[offsets[entry] + r], signals[offsets[entry] + r + lag]
        x_real, x_imag = real_of(x) * scale, imag_of(x) * scale
        z_real, z_imag = real_of(z) * scale, imag_of(z) * scale
        y_real, y_imag = x_real * square, x_imag * square
        real += y_real * z_real + y_imag * z_imag
        imag += y_real * z_imag - y_imag * z_real
        beam_real += x_real * w_real - x_imag * w_imag
        beam_imag += x_real * w_imag + x_imag * w_real
    lags[direction, lag, 0, r], lags[direction, lag, 1, r] = real, imag
    if lag == 0:
        beams[direction, 0, r], beams[direction, 1, r] = beam_real, beam_imag


@cuda.jit(device=True)
def _eliminate(beams, lags, direction, first, centre, epsilon, share, column, thread):
    """Return the magnitude of the solution of ``(ε I + D) t = s`` at range ``centre`` of a window.

    ``column[i, j, part, thread]`` holds L D of ``ε I + D = L D Lᴴ`` below the diagonal, ``L⁻¹ s`` on it, and the
    inverse of D in its last column.
    """
    n_snapshots = column.shape[0]
    last = n_snapshots - 1
    real = imag = inverse = _ZERO
    for j in range(n_snapshots):
        p = centre if j == last else j + (j >= centre)
        for i in range(j, n_snapshots):
            q = centre if i == last else i + (i >= centre)
            low, high = first + min(p, q), first + max(p, q)
            x_real, x_imag = beams[direction, 0, low] * share, beams[direction, 1, low] * share
            y_real, y_imag = beams[direction, 0, high], beams[direction, 1, high]
            real = lags[direction, high - low, 0, low] - (x_real * y_real + x_imag * y_imag)
            imag = lags[direction, high - low, 1, low] - (x_real * y_imag - x_imag * y_real)
            if q < p:
                imag = -imag
            for k in range(j):
                inverse = column[k, n_snapshots, 0, thread]
                a_real, a_imag = column[i, k, 0, thread], column[i, k, 1, thread]
                b_real, b_imag = column[j, k, 0, thread] * inverse, column[j, k, 1, thread] * inverse
                real -= a_real * b_real + a_imag * b_imag
                imag -= a_imag * b_real - a_real * b_imag
            if i == j:
                column[j, n_snapshots, 0, thread] = _ONE / (real + epsilon)
            else:
                column[i, j, 0, thread], column[i, j, 1, thread] = real, imag
        real, imag = beams[direction, 0, first + p], beams[direction, 1, first + p]
        for k in range(j):
            inverse = column[k, n_snapshots, 0, thread]
            a_real, a_imag = column[j, k, 0, thread] * inverse, column[j, k, 1, thread] * inverse
            b_real, b_imag = column[k, k, 0, thread], column[k, k, 1, thread]
            real -= a_real * b_real - a_imag * b_imag
            imag -= a_real * b_imag + a_imag * b_real
        column[j, j, 0, thread], column[j, j, 1, thread] = real, imag
    return math.sqrt(real * real + imag * imag) * column[last, n_snapshots, 0, thread]


@cuda.jit(cache=True)
def _combine(beams, lags, exponent, loading, share, column, first, n_directions, out):
    n_snapshots = column.shape[0]
    n_windows, middle = out.shape[1] - n_snapshots + 1, n_snapshots // 2
    thread = cuda.grid(1)
    unit = share * _scale_of(exponent[0])
    for item in range(thread, n_directions * n_windows, column.shape[3]):
        direction, window = item // n_windows, item % n_windows
        trace = _ZERO
        for k in range(window, window + n_snapshots):
            trace += lags[direction, 0, 0, k]
        # Without any power, every loading yields 0.
        epsilon = loading * trace if trace != _ZERO else loading
        # A window yields the range in its middle; the outermost two also yield those towards the ends.
        begin = 0 if window == 0 else middle
        end = n_snapshots if window == n_windows - 1 else middle + 1
        for c in range(begin, end):
            solved = _eliminate(beams, lags, direction, window, c, epsilon, share, column, thread)
            out[first + direction, window + c] = epsilon * solved * unit


def combine_capon(signals, offsets, weights, n_snapshots, loading, out):
    """Combine the microphones with the Capon (minimum-variance distortionless response) weights."""
    (n_directions, n_mics), n_ranges = offsets.shape, out.shape[1]
    n_snapshots = min(n_snapshots, n_ranges)
    real = np.float32 if weights.dtype == np.complex64 else np.float64
    n_bytes = 2 * np.dtype(real).itemsize
    of_direction, of_thread = n_bytes * n_ranges * (n_snapshots + 1), n_bytes * n_snapshots * (n_snapshots + 1)
    group = max(1, min(_MAX_BYTES // of_direction, n_directions, _MAX_BLOCKS))
    n_windows = group * (n_ranges - n_snapshots + 1)
    n_blocks = -(-min(_MAX_BYTES // of_thread, n_windows) // _BLOCK)
    beams = workspace("capon's beams", (group, 2, n_ranges), real)
    lags = workspace("capon's lags", (group, n_snapshots, 2, n_ranges), real)
    column = workspace("capon's matrices", (n_snapshots, n_snapshots + 1, 2, n_blocks * _BLOCK), real)
    exponent = workspace("capon's exponent", (1,), np.int32)
    tables = complexes(signals), offsets.reshape(-1), weights.reshape(-1).view(real)
    share, loading = real(1 / n_mics), real(loading / n_mics)
    launch(_clear, (1,), (1,), exponent)
    bits = signals.reshape(-1).view(np.uint32)
    launch(_find_exponent, (-(-bits.size // (_BLOCK * _NUMBERS)),), (_BLOCK,), bits, exponent)
    for first in range(0, n_directions, group):
        count = min(group, n_directions - first)
        grid = -(-n_ranges // _BLOCK), n_snapshots, count
        launch(_sum_lags, grid, (_BLOCK,), *tables, exponent, first, n_mics, beams, lags)
        launch(_combine, (n_blocks,), (_BLOCK,), beams, lags, exponent, loading, share, column, first, count, out)
