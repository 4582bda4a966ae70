"""Compute the magnitude of analytic beams."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._scalar import magnitude

__all__ = ["envelope"]


@njit(parallel=True, nogil=True, cache=True, fastmath={"contract"})
def envelope(beams, out):
    """Compute the magnitude of analytic beams."""
    n_directions, n_ranges = beams.shape
    for direction in prange(n_directions):
        for r in range(n_ranges):
            out[direction, r] = np.float32(magnitude(beams[direction, r].real, beams[direction, r].imag))
