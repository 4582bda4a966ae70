"""Filter signals and keep every factor-th sample."""

import numpy as np
from numba import njit, prange

__all__ = ["decimate"]


@njit(parallel=True, nogil=True, cache=True, fastmath={"reassoc", "contract", "nsz"})
def decimate(signals, taps, factor, out):
    """Filter signals and keep every ``factor``-th sample."""
    n_mics, n_samples = signals.shape
    n_taps = taps.size
    for mic in prange(n_mics):
        for n in range(out.shape[1]):
            first = n * factor - (n_taps - 1)
            total = np.float32(0)
            for tap in range(max(0, -first), min(n_taps, n_samples - first)):
                total += taps[tap] * signals[mic, first + tap]
            out[mic, n] = total
