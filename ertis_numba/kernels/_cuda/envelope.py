"""Compute the magnitude of analytic beams."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._cuda.terms import complexes
from ertis_numba.kernels._scalar import imag_of, magnitude, real_of

__all__ = ["envelope"]

_BLOCK = 128


@cuda.jit(cache=True)
def _take(beams, out):
    k = np.uint64(cuda.grid(1))
    if k < np.uint64(out.size):
        out[k] = magnitude(real_of(beams[k]), imag_of(beams[k]))


def envelope(beams, out):
    """Compute the magnitude of analytic beams."""
    launch(_take, (-(-out.size // _BLOCK),), (_BLOCK,), complexes(beams), out.reshape(-1))
