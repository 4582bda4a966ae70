# mypy: ignore-errors
"""Multiply amplitudes by the coherence factor of the microphones."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import BLOCK, DIRECTIONS, TILE, WARP, beam_grid, complexes
from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import coherence_factor, imag_of, power, real_of

__all__ = ["weight_coherence"]

_ONE, _ZERO = np.uint64(1), np.float32(0)  # adding 0 determines which product is fused


@cuda.jit(device=True)
def _add(sums, sample, w_real, w_imag):
    """Return the sums of y (real and imaginary part) and of its power, with another y added."""
    real, imag, total = sums
    y_real = (_ZERO + real_of(sample) * w_real) - imag_of(sample) * w_imag
    y_imag = (_ZERO + real_of(sample) * w_imag) + imag_of(sample) * w_real
    return real + y_real, imag + y_imag, total + power(y_real, y_imag)


@cuda.jit(cache=True)
def _weight(signals, offsets, weights, n_mics, out):
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    n_ranges = np.int64(out.shape[1])
    place = np.int64(cuda.blockIdx.y * TILE + cuda.threadIdx.x)
    if direction >= np.uint64(out.shape[0]) or place >= n_ranges:
        return
    # Ranges beyond the last are read as the last one, and are not written.
    last = n_ranges - 1 - place
    step_1 = np.uint64(min(np.int64(WARP), last))
    step_2 = np.uint64(min(np.int64(2 * WARP), last))
    step_3 = np.uint64(min(np.int64(3 * WARP), last))
    zero = np.float32(0)
    a = b = c = d = (zero, zero, zero)
    entry = direction * np.uint64(n_mics)
    end = entry + np.uint64(n_mics)
    while entry < end:
        weight, at = weights[entry], np.uint32(place + offsets[entry])
        entry += _ONE
        w_real, w_imag = real_of(weight), imag_of(weight)
        a = _add(a, signals[at], w_real, w_imag)
        b = _add(b, signals[at + step_1], w_real, w_imag)
        c = _add(c, signals[at + step_2], w_real, w_imag)
        d = _add(d, signals[at + step_3], w_real, w_imag)
    r, count = np.uint64(place), np.float32(n_mics)
    out[direction, r] *= coherence_factor(a[0], a[1], a[2], count)
    if last >= WARP:
        out[direction, r + step_1] *= coherence_factor(b[0], b[1], b[2], count)
    if last >= 2 * WARP:
        out[direction, r + step_2] *= coherence_factor(c[0], c[1], c[2], count)
    if last >= 3 * WARP:
        out[direction, r + step_3] *= coherence_factor(d[0], d[1], d[2], count)


def weight_coherence(signals, offsets, weights, out):
    """Multiply amplitudes by the coherence factor of Mallart and Fink (1994), which measures agreement."""
    tables = offsets.reshape(-1), complexes(weights), offsets.shape[1]
    launch(_weight, beam_grid(*out.shape), BLOCK, complexes(signals), *tables, out)
