# mypy: ignore-errors
"""Sum the delayed 16-bit signals of all microphones."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch

__all__ = ["sum_delayed_int16"]

_BLOCK = 128


@cuda.jit(cache=True)
def _sum(tiles, units, delays, out):
    direction = np.uint64(cuda.blockIdx.x)
    n = np.uint64(cuda.blockIdx.y * _BLOCK + cuda.threadIdx.x)
    if n >= np.uint64(out.shape[1]):
        return
    in_tile = np.uint64(out.shape[1] // tiles.shape[0])
    tile = n // in_tile
    total = np.int32(0)
    for number in range(delays.shape[1]):
        mic = np.uint64(number)
        total += np.int32(tiles[tile, mic, n - tile * in_tile + np.uint64(delays[direction, mic])])
    out[direction, n] = np.float32(total) * units[tile]


def sum_delayed_int16(tiles, units, delays, out):
    """Sum the delayed 16-bit signals of all microphones for every direction and sample."""
    launch(_sum, (out.shape[0], -(-out.shape[1] // _BLOCK)), (_BLOCK,), tiles, units, delays, out)
