"""Split analytic signals into tiles of ranges, and store each in 16 bits with its own scale."""

import math

import numpy as np
from numba import njit, prange

__all__ = ["largest_in", "quantise_tiles"]


@njit(nogil=True, cache=True)
def largest_in(parts, begin, end, powers, bits):
    """Return the largest magnitude in ``begin … end`` of ``parts``, (mic, phase, 2 samples) float32."""
    # A maximum of bits is one vector instruction, while a maximum of floats is a loop because of NaN.
    n_mics, n_phases, _ = parts.shape
    largest = np.int32(0)
    for mic in range(n_mics):
        for phase in range(n_phases):
            part = parts[mic, phase, 2 * begin : 2 * end]
            for k in range(end - begin):
                powers[k] = part[2 * k] * part[2 * k] + part[2 * k + 1] * part[2 * k + 1]
            for k in range(end - begin):
                largest = max(largest, bits[k])
    bits[0] = largest
    return np.float32(math.sqrt(powers[0]))


@njit(nogil=True, cache=True)
def _round(source, factor, target):
    """Fill ``target`` with the rounded products of ``source`` and ``factor``, and with 0 beyond ``source``."""
    for k in range(source.size):
        target[k] = np.int16(np.rint(source[k] * factor))
    for k in range(source.size, target.size):
        target[k] = np.int16(0)


@njit(parallel=True, nogil=True, cache=True)
def quantise_tiles(signals, starts, limit, tiles, scales):
    """Split analytic signals into tiles of ranges, and store each in 16 bits with its own scale."""
    n_tiles, n_mics, n_phases, width, _ = tiles.shape
    parts, targets = signals.view(np.float32), tiles.reshape(n_tiles, n_mics, n_phases, 2 * width)
    for tile in prange(n_tiles):
        begin, end = starts[tile], min(starts[tile] + width, signals.shape[2])
        powers = np.empty(width, np.float32)
        largest = largest_in(parts, begin, end, powers, powers.view(np.int32))
        scales[tile] = largest / limit
        factor = np.float32(0) if largest == 0 else limit / largest
        for mic in range(n_mics):
            for phase in range(n_phases):
                _round(parts[mic, phase, 2 * begin : 2 * end], factor, targets[tile, mic, phase])
