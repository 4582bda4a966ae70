"""Filter signals and keep every factor-th sample."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch

__all__ = ["decimate"]

_BLOCK = 128


@cuda.jit(cache=True)
def _filter(signals, taps, factor, out):
    n, mic = np.int64(cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x), np.uint64(cuda.blockIdx.y)
    if n >= out.shape[1]:
        return
    first = n * factor - (taps.size - 1)
    tap = max(np.int64(0), -first)
    end = min(np.int64(taps.size), signals.shape[1] - first)
    total = np.float32(0)
    while tap < end:
        total += taps[np.uint64(tap)] * signals[mic, np.uint64(first + tap)]
        tap += 1
    out[mic, np.uint64(n)] = total


def decimate(signals, taps, factor, out):
    """Filter signals and keep every ``factor``-th sample."""
    launch(_filter, (-(-out.shape[1] // _BLOCK), out.shape[0]), (_BLOCK,), signals, taps, factor, out)
