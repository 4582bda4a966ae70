# mypy: ignore-errors
"""Combine the delayed real signals of all microphones: sums, or sums of products, with or without coherence factor."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch

__all__ = ["combine_delayed"]

_BLOCK = 128


@cuda.jit(cache=True)
def _combine(signals, roots, delays, order, coherent, first, out):
    direction = np.uint64(cuda.blockIdx.x)
    n = np.uint64(cuda.blockIdx.y * _BLOCK + cuda.threadIdx.x)
    if n >= np.uint64(out.shape[1]):
        return
    place = n + np.uint64(first)
    total = power = one = two = three = four = five = np.float32(0)
    for number in range(delays.shape[1]):
        mic = np.uint64(number)
        at = place + np.uint64(delays[direction, mic])
        if order == 1 or coherent:
            x = signals[mic, at]
            total += x
            power += x * x
        if order > 1:
            root = roots[mic, at]
            five += four * root
            four += three * root
            three += two * root
            two += one * root
            one += root
    value = total
    if order == 2:
        value = two
    elif order == 3:
        value = three
    elif order == 4:
        value = four
    elif order == 5:
        value = five
    if coherent:
        value *= total * total / (np.float32(delays.shape[1]) * power) if power > 0 else np.float32(0)
    out[direction, n] = value


def combine_delayed(signals, roots, delays, order, coherent, first, out):
    """Combine the delayed real signals of all microphones for every direction and sample."""
    grid = (out.shape[0], -(-out.shape[1] // _BLOCK))
    launch(_combine, grid, (_BLOCK,), signals, roots, delays, order, coherent, first, out)
