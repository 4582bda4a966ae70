"""Sum the delayed and weighted signals of all microphones for every direction and range."""

import numpy as np
from numba import njit, prange

__all__ = ["delay_and_sum"]


@njit(parallel=True, nogil=True, cache=True, fastmath={"contract", "nsz"})
def delay_and_sum(signals, offsets, weights, out):
    """Sum the delayed and weighted signals of all microphones for every direction and range."""
    flat = signals.reshape(-1)
    n_directions, n_mics = offsets.shape
    n_ranges = out.shape[1]
    for direction in prange(n_directions):
        beam = out[direction]
        beam[:] = np.complex64(0)
        for mic in range(n_mics):
            delayed = flat[offsets[direction, mic] : offsets[direction, mic] + n_ranges]
            weight = weights[direction, mic]
            for r in range(n_ranges):
                x, y = delayed[r], beam[r]
                real = (y.real + x.real * weight.real) - x.imag * weight.imag
                imag = (y.imag + x.real * weight.imag) + x.imag * weight.real
                beam[r] = np.complex64(complex(real, imag))
