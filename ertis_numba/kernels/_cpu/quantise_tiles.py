"""Cut analytic signals into tiles of ranges and store each in 16 bits under its own scale."""

import numpy as np
from numba import njit, prange

__all__ = ["quantise_tiles"]


@njit(nogil=True, cache=True)
def _largest(signals, begin, end):
    """Largest squared magnitude of any sample in ``begin … end``, as the bits of a float.

    Non-negative floats are ordered like their bits, and a maximum of integers is one vector
    instruction where a maximum of floats, for the sake of NaN, is a loop.
    """
    n_mics, n_phases, _ = signals.shape
    parts = signals.view(np.float32)
    powers = np.empty(end - begin, np.float32)
    bits = powers.view(np.int32)
    largest = np.int32(0)
    for mic in range(n_mics):
        for phase in range(n_phases):
            part = parts[mic, phase, 2 * begin : 2 * end]
            for k in range(powers.size):
                powers[k] = part[2 * k] * part[2 * k] + part[2 * k + 1] * part[2 * k + 1]
            for k in range(bits.size):
                largest = max(largest, bits[k])
    return largest


@njit(parallel=True, nogil=True, cache=True)
def quantise_tiles(signals, starts, limit, tiles, scales):
    """See `QuantiseTiles`."""
    n_tiles, n_mics, n_phases, width, _ = tiles.shape
    n_samples = signals.shape[2]
    bits = np.zeros(n_tiles, np.int32)
    for tile in prange(n_tiles):
        bits[tile] = _largest(signals, starts[tile], min(starts[tile] + width, n_samples))
    largest = np.sqrt(bits.view(np.float32))
    for tile in range(n_tiles):
        scales[tile] = largest[tile] / limit
    parts = signals.view(np.float32)
    targets = tiles.reshape(n_tiles, n_mics, n_phases, 2 * width)
    for row in prange(n_tiles * n_mics):
        tile, mic = row // n_mics, row % n_mics
        factor = np.float32(0) if largest[tile] == 0 else limit / largest[tile]
        inside = 2 * (min(starts[tile] + width, n_samples) - starts[tile])
        for phase in range(n_phases):
            source = parts[mic, phase, 2 * starts[tile] : 2 * starts[tile] + inside]
            target = targets[tile, mic, phase]
            for k in range(inside):
                target[k] = np.int16(np.rint(source[k] * factor))
            target[inside:] = np.int16(0)
