"""Convert PCM samples to signals."""

import numpy as np
from numba import njit, prange

__all__ = ["unpack_pcm"]

_BLOCK = 512  # samples that stay in the cache during the loop over microphones


@njit(parallel=True, nogil=True, cache=True)
def unpack_pcm(words, channels, scale, silence, first, out):
    """Convert PCM samples to signals: ``out[mic, n] = scale · words[first + n, channels[mic]]``, 0 elsewhere."""
    n_samples = out.shape[1]
    for block in prange((n_samples + _BLOCK - 1) // _BLOCK):
        for mic in range(channels.size):
            channel = channels[mic]
            for n in range(block * _BLOCK, min(n_samples, (block + 1) * _BLOCK)):
                value = np.float32(0)
                if 0 <= first + n < words.shape[0]:
                    value = np.float32(words[first + n, channel])
                out[mic, n] = (np.float32(0) if abs(value) < silence else value) * scale
