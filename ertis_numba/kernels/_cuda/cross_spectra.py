# mypy: ignore-errors
"""Sum the products of the spectra of each two microphones over blocks of samples."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import imag_of, real_of, sample_of

__all__ = ["cross_spectra"]

_BINS, _PARTNERS = 32, 4
_ZERO = np.float32(0)


@cuda.jit(cache=True)
def _sum(spectra, first, out):
    k = np.uint64(cuda.blockIdx.x * _BINS + cuda.threadIdx.x)
    i = np.uint64(cuda.blockIdx.y)
    j = np.uint64(cuda.blockIdx.z * _PARTNERS + cuda.threadIdx.y)
    if k >= np.uint64(out.shape[0]) or j >= np.uint64(out.shape[1]) or j < i:
        return
    at = np.uint64(first) + k
    x, y = _ZERO, _ZERO
    for number in range(spectra.shape[1]):
        block = np.uint64(number)
        one, other = spectra[i, block, at], spectra[j, block, at]
        a, b, c, d = real_of(one), imag_of(one), real_of(other), imag_of(other)
        x = (x + a * c) + b * d
        y = (y + b * c) - a * d
    out[k, i, j] = sample_of(x, y)
    if j != i:
        out[k, j, i] = sample_of(x, -y)


def cross_spectra(spectra, first, out):
    """Sum the products of the spectra of each two microphones over blocks of samples."""
    n_bins, n_mics, _ = out.shape
    grid = -(-n_bins // _BINS), n_mics, -(-n_mics // _PARTNERS)
    launch(_sum, grid, (_BINS, _PARTNERS), spectra.view(np.uint64), first, out.view(np.uint64))
