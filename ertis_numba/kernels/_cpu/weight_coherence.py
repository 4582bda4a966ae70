# mypy: ignore-errors
"""Multiply amplitudes by the coherence factor of the microphones."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._scalar import coherence_factor

__all__ = ["weight_coherence"]

_ZERO = np.float32(0)  # adding it determines which product is fused
_TILE = 256  # ranges whose sums stay in the L1 cache during the loop over microphones


@njit(parallel=True, nogil=True, cache=True, error_model="numpy", fastmath={"contract"})
def weight_coherence(signals, offsets, weights, out):
    """Multiply amplitudes by the coherence factor of Mallart and Fink (1994), which measures agreement."""
    flat = signals.reshape(-1)
    n_directions, n_mics = offsets.shape
    n_ranges = out.shape[1]
    for direction in prange(n_directions):
        real, imag, total = np.empty(_TILE, np.float32), np.empty(_TILE, np.float32), np.empty(_TILE, np.float32)
        for first in range(0, n_ranges, _TILE):
            count = min(_TILE, n_ranges - first)
            real[:count], imag[:count], total[:count] = 0, 0, 0
            for mic in range(n_mics):
                begin = offsets[direction, mic] + first
                delayed = flat[begin : begin + count]
                weight = weights[direction, mic]
                for r in range(count):
                    x = delayed[r]
                    y_real = (_ZERO + x.real * weight.real) - x.imag * weight.imag
                    y_imag = (_ZERO + x.real * weight.imag) + x.imag * weight.real
                    real[r] += y_real
                    imag[r] += y_imag
                    total[r] = (total[r] + y_real * y_real) + y_imag * y_imag
            for r in range(count):
                out[direction, first + r] *= coherence_factor(real[r], imag[r], total[r], np.float32(n_mics))
