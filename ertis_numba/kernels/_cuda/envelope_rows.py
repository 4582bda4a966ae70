# mypy: ignore-errors
"""Compute the magnitude of successive samples of beams."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import imag_of, magnitude, real_of

__all__ = ["envelope_rows"]

_BLOCK = 128


@cuda.jit(cache=True)
def _take(beams, lead, first, stop, out):
    row = np.uint64(cuda.blockIdx.x)
    r = np.uint64(first + cuda.blockIdx.y * _BLOCK + cuda.threadIdx.x)
    if r < np.uint64(stop):
        beam = beams[row, 0, np.uint64(lead) + r]
        out[row, r] = magnitude(real_of(beam), imag_of(beam))


def envelope_rows(beams, lead, first, stop, out):
    """Compute the magnitude of successive samples: ``out[row, range] = |beams[row, 0, lead + range]|``."""
    launch(
        _take, (out.shape[0], -(-(stop - first) // _BLOCK)), (_BLOCK,), beams.view(np.uint64), lead, first, stop, out
    )
