"""Compute the magnitude of every step-th sample of analytic beams."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._scalar import magnitude

__all__ = ["envelope"]


@njit(parallel=True, nogil=True, cache=True, fastmath={"contract"})
def envelope(beams, step, out):
    """Compute the magnitude of every ``step``-th sample of analytic beams."""
    n_directions, n_ranges = out.shape
    for direction in prange(n_directions):
        for r in range(n_ranges):
            beam = beams[direction, r * step]
            out[direction, r] = np.float32(magnitude(beam.real, beam.imag))
