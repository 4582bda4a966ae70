"""Multiply the spectrum of each microphone by a filter."""

import numpy as np
from numba import njit, prange

__all__ = ["multiply_spectra"]

_ZERO = np.float32(0)  # adding it determines which product is fused


@njit(parallel=True, nogil=True, cache=True, fastmath={"contract"})
def multiply_spectra(spectra, response, out):
    """Multiply the spectrum of each microphone by a filter: ``out[mic, bin] = spectra · response``."""
    n_mics, n_bins = spectra.shape
    for mic in prange(n_mics):
        for b in range(n_bins):
            # Written out, because Numba never fuses its own complex product to multiply-adds.
            x, h = spectra[mic, b], response[b]
            real = (_ZERO + x.real * h.real) - x.imag * h.imag
            imag = (_ZERO + x.real * h.imag) + x.imag * h.real
            out[mic, b] = np.complex64(complex(real, imag))
        out[mic, n_bins:] = np.complex64(0)
