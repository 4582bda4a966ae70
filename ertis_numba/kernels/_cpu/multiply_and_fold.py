"""Multiply spectra by one filter per phase, and fold each product to the length of the output."""

import numpy as np
from numba import njit, prange

__all__ = ["multiply_and_fold"]


@njit(parallel=True, nogil=True, cache=True, fastmath={"contract", "nsz"})
def multiply_and_fold(spectra, responses, first_bin, out):
    """Multiply spectra by one filter per phase and fold each product to the length of ``out``."""
    n_mics, n_phases, n_out = out.shape
    n_bins = responses.shape[2]
    for mic in prange(n_mics):
        row = min(np.int64(mic), np.int64(responses.shape[0] - 1))  # one row may apply to all
        for phase in range(n_phases):
            out[mic, phase, :] = np.complex64(0)
            done = 0
            while done < n_bins:
                # This run of bins does not wrap around, so that the inner loop needs no modulo operation.
                place = (first_bin + done) % n_out
                run = min(n_bins - done, n_out - place)
                x = spectra[mic, first_bin + done : first_bin + done + run]
                h = responses[row, phase, done : done + run]
                y = out[mic, phase, place : place + run]
                for b in range(run):
                    real = (y[b].real + x[b].real * h[b].real) - x[b].imag * h[b].imag
                    imag = (y[b].imag + x[b].real * h[b].imag) + x[b].imag * h[b].real
                    y[b] = np.complex64(complex(real, imag))
                done += run
