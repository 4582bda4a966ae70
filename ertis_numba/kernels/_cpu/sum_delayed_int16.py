# mypy: ignore-errors
"""Sum the delayed 16-bit signals of all microphones. This takes half of the time that float32 takes."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.vectors import REGISTER_BYTES, load, store

__all__ = ["sum_delayed_int16"]

_REGISTERS = 4
_WIDTH = _REGISTERS * REGISTER_BYTES // 2  # samples that are summed at a time
_DIRECTIONS = 32  # directions per block
_TILE_NUMBERS = 8_192  # samples of all microphones in a tile, which fits into an L1 cache


@njit(nogil=True, cache=True)
def _sum_tile(signals, starts, low, high, out, direction):
    """Write the samples from ``low`` to ``high`` of a direction.

    The last vector overlaps the one before it, and computes some samples again.
    """
    n_samples = out.shape[1]
    for begin in range(low, high, _WIDTH):
        place = min(begin, n_samples - _WIDTH)
        total = load(signals, starts[0] + place, _REGISTERS)
        for mic in range(1, len(starts)):
            total = total + load(signals, starts[mic] + place, _REGISTERS)
        store(total, out, direction * n_samples + place)


@njit(parallel=True, nogil=True, cache=True)
def sum_delayed_int16(signals, delays, first, out):
    """Sum the delayed 16-bit signals of all microphones for every direction and sample."""
    n_directions, n_mics = delays.shape
    n_samples, stride = out.shape[1], signals.shape[1]
    tile = max(1, _TILE_NUMBERS // n_mics // _WIDTH) * _WIDTH
    for block in prange((n_directions + _DIRECTIONS - 1) // _DIRECTIONS):
        begin, end = block * _DIRECTIONS, min((block + 1) * _DIRECTIONS, n_directions)
        starts = np.empty((end - begin, n_mics), np.int64)
        for direction in range(begin, end):
            for mic in range(n_mics):
                starts[direction - begin, mic] = mic * stride + first + delays[direction, mic]
        if n_samples < _WIDTH:
            for direction in range(begin, end):
                out[direction] = 0
                for mic in range(n_mics):
                    for n in range(n_samples):
                        out[direction, n] += signals.flat[starts[direction - begin, mic] + n]
            continue
        # All directions of a block use one tile of the signals, which the cache holds, before the next.
        for low in range(0, n_samples, tile):
            for direction in range(begin, end):
                _sum_tile(signals, starts[direction - begin], low, min(low + tile, n_samples), out, direction)
