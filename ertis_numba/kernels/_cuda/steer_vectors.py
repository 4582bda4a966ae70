# mypy: ignore-errors
"""Compute the power that vectors have for the wave from each direction.

Groups of eight microphones are summed first, which reduces rounding errors to about a third.
"""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._scalar import cosine_and_sine, imag_of, real_of, sample_of

__all__ = ["steer_vectors"]

_BLOCK = 128
_ZERO, _ONE = np.float32(0), np.uint64(1)
_SUMMED = np.uint64(8)  # microphones


@cuda.jit(cache=True)
def _steer(vectors, steps, bins, phases, out):
    direction = np.uint64(cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x)
    k = np.uint64(cuda.blockIdx.y)
    if direction >= np.uint64(out.shape[1]):
        return
    n_mics, number = np.uint64(steps.shape[0]), np.uint64(bins[k])
    mic = np.uint64(0)
    while mic < n_mics:
        real, imag = cosine_and_sine(np.uint32(np.uint64(steps[mic, direction]) * number))
        phases[k, mic, direction] = sample_of(real, -imag)
        mic += _ONE
    total = _ZERO
    i = np.uint64(0)
    while i < np.uint64(vectors.shape[1]):
        x, y = _ZERO, _ZERO
        mic = np.uint64(0)
        while mic < n_mics:
            p, q = _ZERO, _ZERO
            stop = min(mic + _SUMMED, n_mics)
            while mic < stop:
                element, phase = vectors[k, i, mic], phases[k, mic, direction]
                a, b, c, d = real_of(element), imag_of(element), real_of(phase), imag_of(phase)
                p = (p + a * c) + b * d
                q = (q + a * d) - b * c
                mic += _ONE
            x, y = x + p, y + q
        total = (total + x * x) + y * y
        i += _ONE
    out[k, direction] = total


def steer_vectors(vectors, steps, bins, out):
    """Compute the power that vectors have for the wave from each direction."""
    n_bins, n_directions = out.shape
    phases = workspace("steer_vectors", (n_bins, *steps.shape), np.uint64)
    grid = -(-n_directions // _BLOCK), n_bins
    launch(_steer, grid, (_BLOCK,), vectors.view(np.uint64), steps, bins, phases, out)
