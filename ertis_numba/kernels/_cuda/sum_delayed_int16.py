# mypy: ignore-errors
"""Sum the delayed 16-bit signals of all microphones."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch

__all__ = ["sum_delayed_int16"]

_BLOCK = 128


@cuda.jit(cache=True)
def _sum(signals, delays, first, out):
    direction = np.uint64(cuda.blockIdx.x)
    n = np.uint64(cuda.blockIdx.y * _BLOCK + cuda.threadIdx.x)
    if n >= np.uint64(out.shape[1]):
        return
    place = n + np.uint64(first)
    total = np.int32(0)
    for number in range(delays.shape[1]):
        mic = np.uint64(number)
        total += np.int32(signals[mic, place + np.uint64(delays[direction, mic])])
    out[direction, n] = np.int16(total)


def sum_delayed_int16(signals, delays, first, out):
    """Sum the delayed 16-bit signals of all microphones for every direction and sample."""
    launch(_sum, (out.shape[0], -(-out.shape[1] // _BLOCK)), (_BLOCK,), signals, delays, first, out)
