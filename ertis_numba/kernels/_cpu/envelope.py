"""Take the magnitude of analytic beams."""

import math

import numpy as np
from numba import njit, prange

__all__ = ["envelope"]


@njit(parallel=True, nogil=True, cache=True, fastmath={"contract", "nsz"})
def envelope(beams, out):
    """See `Envelope`."""
    n_directions, n_ranges = beams.shape
    for direction in prange(n_directions):
        for r in range(n_ranges):
            beam = beams[direction, r]
            # abs() of a complex number guards against overflow and is ten times slower.
            out[direction, r] = np.float32(math.sqrt(beam.real * beam.real + beam.imag * beam.imag))
