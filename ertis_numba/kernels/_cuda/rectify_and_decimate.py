# mypy: ignore-errors
"""Rectify real beams, filter them, and keep every factor-th sample."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch

__all__ = ["rectify_and_decimate"]

_BLOCK = 128


@cuda.jit(cache=True)
def _filter(beams, taps, scale, factor, first, out):
    direction = np.uint64(cuda.blockIdx.x)
    r = np.uint64(cuda.blockIdx.y * _BLOCK + cuda.threadIdx.x)
    if r >= np.uint64(out.shape[1]):
        return
    start = np.uint64(first) + r * np.uint64(factor)
    total = np.float32(0)
    for number in range(taps.size):
        tap = np.uint64(number)
        total += np.float32(taps[tap]) * abs(beams[direction, start + tap])
    out[direction, r] = scale * total


def rectify_and_decimate(beams, taps, scale, factor, first, out):
    """Rectify real beams, filter them, and keep every factor-th sample."""
    grid = (out.shape[0], -(-out.shape[1] // _BLOCK))
    launch(_filter, grid, (_BLOCK,), beams, taps, np.float32(scale), factor, first, out)
