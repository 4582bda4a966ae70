"""Convert the bits of PDM words to signals of +1 and −1."""

import numpy as np
from numba import njit, prange

__all__ = ["unpack_bits"]


@njit(parallel=True, nogil=True, cache=True)
def unpack_bits(words, channels, out):
    """Convert the bits of PDM words to signals of +1 and −1."""
    word_bits = words.itemsize * 8
    for mic in prange(channels.size):
        word = channels[mic] // word_bits
        shift = channels[mic] % word_bits
        for sample in range(words.shape[0]):
            # Converted to int64, because Numba would convert a mix of uint64 and signed numbers to float64.
            bit = np.int64(words[sample, word] >> np.uint64(shift)) & 1
            out[mic, sample] = np.float32(2 * bit - 1)
