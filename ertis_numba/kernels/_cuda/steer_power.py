# mypy: ignore-errors
"""Compute the power that Hermitian matrices have for the wave from each direction."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._scalar import cosine_and_sine, imag_of, real_of, sample_of

__all__ = ["steer_power"]

_BLOCK = 128
_ZERO, _TWO, _ONE = np.float32(0), np.float32(2), np.uint64(1)


@cuda.jit(cache=True)
def _steer(matrices, steps, bins, phases, out):
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
    trace, total = _ZERO, _ZERO
    i = np.uint64(0)
    while i < n_mics:
        trace += real_of(matrices[k, i, i])
        x, y = _ZERO, _ZERO
        j = i + _ONE
        while j < n_mics:
            element, phase = matrices[k, i, j], phases[k, j, direction]
            a, b, c, d = real_of(element), imag_of(element), real_of(phase), imag_of(phase)
            x = (x + a * c) - b * d
            y = (y + a * d) + b * c
            j += _ONE
        phase = phases[k, i, direction]
        total = (total + real_of(phase) * x) + imag_of(phase) * y
        i += _ONE
    out[k, direction] = trace + _TWO * total


def steer_power(matrices, steps, bins, out):
    """Compute the power that Hermitian matrices have for the wave from each direction."""
    n_bins, n_directions = out.shape
    phases = workspace("steer_power", (n_bins, *steps.shape), np.uint64)
    grid = -(-n_directions // _BLOCK), n_bins
    launch(_steer, grid, (_BLOCK,), matrices.view(np.uint64), steps, bins, phases, out)
