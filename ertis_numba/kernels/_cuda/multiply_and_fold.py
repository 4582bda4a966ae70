"""Multiply spectra by one filter per phase, and fold each product to the length of the output."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import imag_of, real_of, sample_of

__all__ = ["multiply_and_fold"]

_BLOCK = 128


@cuda.jit(cache=True)
def _fold(spectra, responses, first_bin, ahead, out):
    """Fill one bin of ``out``."""
    # `ahead` leads to the next multiple of the length of `out`; a remainder is expensive on a GPU.
    k = np.int64(cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x)
    if k >= out.shape[2]:
        return
    phase, mic = np.uint64(cuda.blockIdx.y), np.uint64(cuda.blockIdx.z)
    row = mic if responses.shape[0] > 1 else np.uint64(0)
    n_out = np.int64(out.shape[2])
    real = imag = np.float32(0)
    b = k + ahead
    if b >= n_out:
        b -= n_out
    while b < responses.shape[2]:
        x, h = spectra[mic, np.uint64(first_bin + b)], responses[row, phase, np.uint64(b)]
        real = (real + real_of(x) * real_of(h)) - imag_of(x) * imag_of(h)
        imag = (imag + real_of(x) * imag_of(h)) + imag_of(x) * real_of(h)
        b += n_out
    out[mic, phase, np.uint64(k)] = sample_of(real, imag)


def multiply_and_fold(spectra, responses, first_bin, out):
    """Multiply spectra by one filter per phase and fold each product to the length of ``out``."""
    n_mics, n_phases, n_out = out.shape
    grid, numbers = (-(-n_out // _BLOCK), n_phases, n_mics), (spectra.view(np.uint64), responses.view(np.uint64))
    launch(_fold, grid, (_BLOCK,), *numbers, first_bin, -first_bin % n_out, out.view(np.uint64))
