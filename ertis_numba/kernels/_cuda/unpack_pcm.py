"""Convert PCM samples to signals."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import launch

__all__ = ["unpack_pcm"]

_BLOCK = 128


@cuda.jit(cache=True)
def _unpack(words, channels, scale, silence, first, out):
    n = np.int64(cuda.grid(1))
    if n >= out.shape[1]:
        return
    sample = first + n
    inside = 0 <= sample < words.shape[0]
    for mic in range(np.uint64(channels.size)):
        value = np.float32(0)
        if inside:
            value = np.float32(words[np.uint64(sample), np.uint64(channels[mic])])
        out[mic, np.uint64(n)] = (np.float32(0) if abs(value) < silence else value) * scale


def unpack_pcm(words, channels, scale, silence, first, out):
    """Convert PCM samples to signals: ``out[mic, n] = scale · words[first + n, channels[mic]]``, 0 elsewhere."""
    launch(_unpack, (-(-out.shape[1] // _BLOCK),), (_BLOCK,), words, channels, scale, silence, first, out)
