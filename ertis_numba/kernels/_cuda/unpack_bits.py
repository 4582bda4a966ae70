"""Convert the bits of PDM words to signals of +1 and −1."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch

__all__ = ["unpack_bits"]

_BLOCK = 128


@cuda.jit(cache=True)
def _unpack(octets, channels, out):
    sample = np.uint64(cuda.grid(1))
    if sample >= np.uint64(out.shape[1]):
        return
    for mic in range(np.uint64(channels.size)):
        channel = np.uint32(channels[mic])
        mask = np.uint8(np.uint32(1) << (channel & np.uint32(7)))
        above = octets[sample, channel >> np.uint32(3)] & mask
        out[mic, sample] = np.float32(1) if above else np.float32(-1)


def unpack_bits(words, channels, out):
    """Convert the bits of PDM words to signals of +1 and −1."""
    launch(_unpack, (-(-out.shape[1] // _BLOCK),), (_BLOCK,), words.view(np.uint8), channels, out)
