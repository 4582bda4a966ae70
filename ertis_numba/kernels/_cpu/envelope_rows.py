# mypy: ignore-errors
"""Compute the magnitude of successive samples of beams."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._scalar import magnitude

__all__ = ["envelope_rows"]


@njit(parallel=True, nogil=True, cache=True, fastmath={"contract"})
def envelope_rows(beams, lead, first, stop, out):
    """Compute the magnitude of successive samples: ``out[row, range] = |beams[row, 0, lead + range]|``."""
    for row in prange(out.shape[0]):
        source, target = beams[row, 0, lead + first : lead + stop], out[row, first:stop]
        for r in range(len(target)):
            target[r] = np.float32(magnitude(source[r].real, source[r].imag))
