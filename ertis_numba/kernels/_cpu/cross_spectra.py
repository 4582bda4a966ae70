# mypy: ignore-errors
"""Sum the products of the spectra of each two microphones over blocks of samples."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.vectors import REGISTER_BYTES, add_product, load, splat, store, subtract_product

__all__ = ["cross_spectra"]

_LANES = REGISTER_BYTES // 4
_ZERO = np.float32(0)


@njit(nogil=True, cache=True)
def _separate(spectra, first, count, planes):
    """Fill (mic, block, part, lane) with the parts of ``count`` bins, and zeros."""
    for mic in range(spectra.shape[0]):
        for block in range(spectra.shape[1]):
            for lane in range(_LANES):
                value = spectra[mic, block, first + lane] if lane < count else np.complex64(0)
                planes[mic, block, 0, lane], planes[mic, block, 1, lane] = value.real, value.imag


@njit(nogil=True, cache=True)
def _sum_pair(planes, i, j, sums):
    """Fill (part, lane) with the sums of two microphones."""
    n_blocks = planes.shape[1]
    x = splat(planes, _ZERO, 1)
    y = splat(planes, _ZERO, 1)
    at, other = i * n_blocks * 2 * _LANES, j * n_blocks * 2 * _LANES
    for _ in range(n_blocks):
        a, b = load(planes, at, 1), load(planes, at + _LANES, 1)
        c, d = load(planes, other, 1), load(planes, other + _LANES, 1)
        x = add_product(add_product(x, a, c), b, d)
        y = subtract_product(add_product(y, b, c), a, d)
        at += 2 * _LANES
        other += 2 * _LANES
    store(x, sums, 0)
    store(y, sums, _LANES)


@njit(parallel=True, nogil=True, cache=True)
def cross_spectra(spectra, first, out):
    """Sum the products of the spectra of each two microphones over blocks of samples."""
    n_bins, n_mics, _ = out.shape
    for chunk in prange((n_bins + _LANES - 1) // _LANES):
        begin = chunk * _LANES
        count = min(_LANES, n_bins - begin)
        planes = np.empty((n_mics, spectra.shape[1], 2, _LANES), np.float32)
        sums = np.empty((2, _LANES), np.float32)
        _separate(spectra, first + begin, count, planes)
        for i in range(n_mics):
            for j in range(i, n_mics):
                _sum_pair(planes, i, j, sums)
                for lane in range(count):
                    out[begin + lane, i, j] = np.complex64(complex(sums[0, lane], sums[1, lane]))
                    out[begin + lane, j, i] = np.complex64(complex(sums[0, lane], -sums[1, lane]))
