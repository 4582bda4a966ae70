# mypy: ignore-errors
"""Multiply the roots of the microphones' signals with one another, and sum the products.

Each order has its own kernel, so that the sums stay in registers.
"""

import functools

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import BLOCK, DIRECTIONS, WARP, complexes
from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._scalar import imag_of, magnitude, real_of, root_of, sample_of

__all__ = ["combine_dmas"]

_BLOCK = 128
_ONE = np.uint64(1)


@cuda.jit(cache=True)
def _take_roots(signals, order, roots):
    k = np.uint64(cuda.grid(1))
    if k < np.uint64(signals.size):
        real, imag = root_of(real_of(signals[k]), imag_of(signals[k]), order)
        roots[k] = sample_of(real, imag)


@functools.cache
def _kernel_of(order):
    """Return the kernel that sums the products of ``order`` microphones."""

    @cuda.jit(cache=True)
    def combine(roots, offsets, weights, n_mics, out):
        direction = np.uint64(cuda.blockIdx.x * DIRECTIONS + cuda.threadIdx.y)
        place = np.int64(cuda.blockIdx.y * WARP + cuda.threadIdx.x)
        if direction >= np.uint64(out.shape[0]) or place >= out.shape[1]:
            return
        # Sums of products of 1, 2, … order of the microphones so far.
        real = cuda.local.array(order, np.float32)
        imag = cuda.local.array(order, np.float32)
        for k in range(order):
            real[k] = imag[k] = np.float32(0)
        entry = direction * np.uint64(n_mics)
        end = entry + np.uint64(n_mics)
        while entry < end:
            w_real, w_imag = real_of(weights[entry]), imag_of(weights[entry])
            root = roots[np.uint32(place + offsets[entry])]
            entry += _ONE
            z_real = real_of(root) * w_real - imag_of(root) * w_imag
            z_imag = real_of(root) * w_imag + imag_of(root) * w_real
            # From the highest order down, so that no microphone is multiplied with itself.
            for k in range(order - 1, 0, -1):
                x_real, x_imag = real[k - 1], imag[k - 1]
                real[k] = (real[k] + z_real * x_real) - z_imag * x_imag
                imag[k] = (imag[k] + z_real * x_imag) + z_imag * x_real
            real[0] += z_real
            imag[0] += z_imag
        out[direction, np.uint64(place)] = magnitude(real[order - 1], imag[order - 1])

    return combine


def combine_dmas(signals, offsets, weights, order, out):
    """Delay-multiply-and-sum: sum the products of the roots of all combinations of ``order`` microphones."""
    samples = complexes(signals)
    roots = workspace("roots", samples.shape, np.uint64)
    launch(_take_roots, (-(-samples.size // _BLOCK),), (_BLOCK,), samples, order, roots)
    n_directions, n_ranges = out.shape
    grid = -(-n_directions // DIRECTIONS), -(-n_ranges // WARP)
    tables = offsets.reshape(-1), complexes(weights), offsets.shape[1]
    launch(_kernel_of(int(order)), grid, BLOCK, roots, *tables, out)
