"""Advance signals in time."""

import numpy as np
from numba import njit, prange

__all__ = ["remove_group_delay"]


@njit(parallel=True, nogil=True, cache=True)
def remove_group_delay(signals, delay, out):
    """Advance signals in time: ``out[mic, n] = signals[mic, n + delay]``, 0 beyond the end."""
    n_mics, n_samples = signals.shape
    for mic in prange(n_mics):
        for n in range(out.shape[1]):
            out[mic, n] = signals[mic, n + delay] if n + delay < n_samples else np.float32(0)
