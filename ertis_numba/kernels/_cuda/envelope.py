"""Compute the magnitude of every step-th sample of analytic beams."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import imag_of, magnitude, real_of

__all__ = ["envelope"]

_BLOCK = 128


@cuda.jit(cache=True)
def _take(beams, step, out):
    r, direction = np.uint64(cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x), np.uint64(cuda.blockIdx.y)
    if r < np.uint64(out.shape[1]):
        beam = beams[direction, r * np.uint64(step)]
        out[direction, r] = magnitude(real_of(beam), imag_of(beam))


def envelope(beams, step, out):
    """Compute the magnitude of every ``step``-th sample of analytic beams."""
    launch(_take, (-(-out.shape[1] // _BLOCK), out.shape[0]), (_BLOCK,), beams.view(np.uint64), step, out)
