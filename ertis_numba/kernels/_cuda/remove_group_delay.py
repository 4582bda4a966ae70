"""Advance signals in time."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch

__all__ = ["remove_group_delay"]

_BLOCK = 128


@cuda.jit(cache=True)
def _move(signals, delay, out):
    n, mic = np.int64(cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x), np.uint64(cuda.blockIdx.y)
    if n < out.shape[1]:
        source = n + delay
        out[mic, np.uint64(n)] = signals[mic, np.uint64(source)] if source < signals.shape[1] else np.float32(0)


def remove_group_delay(signals, delay, out):
    """Advance signals in time: ``out[mic, n] = signals[mic, n + delay]``, 0 beyond the end."""
    launch(_move, (-(-out.shape[1] // _BLOCK), out.shape[0]), (_BLOCK,), signals, delay, out)
