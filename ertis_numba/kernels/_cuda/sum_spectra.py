# mypy: ignore-errors
"""Delay spectra by phase shifts, and sum them over the microphones."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import (
    BLOCK,
    DIRECTIONS,
    ONE,
    TILE,
    WARP,
    WARPS_1,
    WARPS_2,
    WARPS_3,
    beam_grid,
)
from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import cosine_and_sine, imag_of, real_of, sample_of

__all__ = ["sum_spectra"]


@cuda.jit(device=True)
def _place(first, ahead, n):
    """Return ``(first + ahead) mod n`` for numbers below n; larger values of ``ahead`` count as ``n − 1``."""
    place = first + min(ahead, n - ONE)
    return place if place < n else place - n


@cuda.jit(device=True)
def _turned(real, imag, turn_real, turn_imag):
    return real * turn_real - imag * turn_imag, real * turn_imag + imag * turn_real


@cuda.jit(device=True)
def _product(real, imag, x, phase_real, phase_imag):
    """Return a sum, increased by the product of a sample and a phase."""
    real = (real + real_of(x) * phase_real) - imag_of(x) * phase_imag
    imag = (imag + real_of(x) * phase_imag) + imag_of(x) * phase_real
    return real, imag


@cuda.jit(device=True)
def _write(out, direction, first_place, k, real, imag):
    n_out = np.uint64(out.shape[2])
    if k < n_out:
        out[direction, 0, _place(first_place, k, n_out)] = sample_of(real, imag)


@cuda.jit(cache=True)
def _sum(spectra, starts, steps, first_read, first_written, n_bins, out):
    """Fill four places of a direction. ``first_read`` and ``first_written`` are those of the first bin."""
    direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
    if direction >= np.uint64(starts.shape[0]):
        return
    k = np.uint64(cuda.blockIdx.y * TILE + cuda.threadIdx.x)
    n_in, n_out = np.uint64(spectra.shape[2]), np.uint64(out.shape[2])
    read, written = np.uint64(first_read), np.uint64(first_written)
    a_real = a_imag = b_real = b_imag = c_real = c_imag = d_real = d_imag = np.float32(0)
    b = k
    while b < np.uint64(n_bins):  # bins that share a place
        at, next_at = _place(read, b, n_in), _place(read, b + WARPS_1, n_in)
        third, last = _place(read, b + WARPS_2, n_in), _place(read, b + WARPS_3, n_in)
        for mic in range(spectra.shape[0]):
            m = np.uint64(mic)
            step = np.uint64(steps[direction, m])
            real, imag = cosine_and_sine(np.uint64(starts[direction, m]) + b * step)
            turn_real, turn_imag = cosine_and_sine(np.uint64(WARP) * step)
            a_real, a_imag = _product(a_real, a_imag, spectra[m, 0, at], real, imag)
            real, imag = _turned(real, imag, turn_real, turn_imag)
            b_real, b_imag = _product(b_real, b_imag, spectra[m, 0, next_at], real, imag)
            real, imag = _turned(real, imag, turn_real, turn_imag)
            c_real, c_imag = _product(c_real, c_imag, spectra[m, 0, third], real, imag)
            real, imag = _turned(real, imag, turn_real, turn_imag)
            d_real, d_imag = _product(d_real, d_imag, spectra[m, 0, last], real, imag)
        b += n_out
    _write(out, direction, written, k, a_real, a_imag)
    _write(out, direction, written, k + WARPS_1, b_real, b_imag)
    _write(out, direction, written, k + WARPS_2, c_real, c_imag)
    _write(out, direction, written, k + WARPS_3, d_real, d_imag)


def sum_spectra(spectra, starts, steps, first_bin, n_bins, out):
    """Delay spectra by phase shifts, and sum them over the microphones: one matrix-vector product per bin."""
    n_in, n_out = spectra.shape[2], out.shape[2]
    firsts, arrays = (first_bin % n_in, first_bin % n_out), (spectra.view(np.uint64), starts, steps)
    launch(_sum, beam_grid(starts.shape[0], n_out), BLOCK, *arrays, *firsts, n_bins, out.view(np.uint64))
