"""Add delayed and filtered copies of a call's spectrum."""

import math

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import between

__all__ = ["add_paths"]

_BLOCK = 128


@cuda.jit(cache=True)
def _add(call, turns, amplitude, first_bin, nodes_per_bin, out):
    k, mic = np.int64(cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x), np.int64(cuda.blockIdx.y)
    if k >= out.shape[1]:
        return
    last = np.int64(amplitude.shape[2] - 1)
    place = (first_bin + k) * nodes_per_bin
    node = min(np.int64(place), last)
    after, part = min(node + 1, last), place - node
    real = imag = 0.0
    for path in range(turns.shape[0]):
        turned = turns[path, mic] * (first_bin + k)
        angle = 2.0 * math.pi * (turned - math.floor(turned))
        gain = between(amplitude[path, mic, node], amplitude[path, mic, after], part)
        real += gain * math.cos(angle)
        imag -= gain * math.sin(angle)
    x = call[mic if call.shape[0] > 1 else np.int64(0), k]
    out[mic, k] += complex(real * x.real - imag * x.imag, real * x.imag + imag * x.real)


def add_paths(call, turns, amplitude, first_bin, nodes_per_bin, out):
    """Add delayed and filtered copies of a call to the spectrum of each microphone."""
    grid = -(-out.shape[1] // _BLOCK), out.shape[0]
    launch(_add, grid, (_BLOCK,), call, turns, amplitude, first_bin, nodes_per_bin, out)
