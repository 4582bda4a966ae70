"""Multiply the spectrum of each microphone by a filter."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import imag_of, real_of, sample_of

__all__ = ["multiply_spectra"]

_BLOCK = 128


@cuda.jit(cache=True)
def _multiply(spectra, response, out):
    k, mic = np.uint64(cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x), np.uint64(cuda.blockIdx.y)
    if k >= np.uint64(out.shape[1]):
        return
    if k >= np.uint64(response.size):
        out[mic, k] = np.uint64(0)
    else:
        x, h = spectra[mic, k], response[k]
        x_real, x_imag, h_real, h_imag = real_of(x), imag_of(x), real_of(h), imag_of(h)
        out[mic, k] = sample_of(x_real * h_real - x_imag * h_imag, x_real * h_imag + x_imag * h_real)


def multiply_spectra(spectra, response, out):
    """Multiply the spectrum of each microphone by a filter: ``out[mic, bin] = spectra · response``."""
    numbers = spectra.view(np.uint64), response.view(np.uint64), out.view(np.uint64)
    launch(_multiply, (-(-out.shape[1] // _BLOCK), out.shape[0]), (_BLOCK,), *numbers)
