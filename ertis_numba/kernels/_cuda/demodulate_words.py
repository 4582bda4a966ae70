"""Unpack, decimate and remove the group delay in one pass over the PDM words."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import indexed
from ertis_numba.kernels._cuda.lane import launch

__all__ = ["demodulate_words"]

_MICS, _THREADS = 32, 128  # maximum per block
_ONE = np.uint32(1)


@cuda.jit(cache=True)
def _sum_taps(octets, n_samples, n_octets, channels, taps, scale, factor, first, n_outputs, out):
    """Fill one output; ``octets`` is a flat array of the bytes of all words, ``n_octets`` per sample."""
    n = np.int64(cuda.blockIdx.x * cuda.blockDim.y + cuda.threadIdx.y)
    mic = np.int64(cuda.blockIdx.y * cuda.blockDim.x + cuda.threadIdx.x)
    if n >= out.shape[1] or mic >= out.shape[0]:
        return
    total = np.int32(0)
    if n < n_outputs:
        channel = np.uint32(channels[mic])
        mask = np.uint8(_ONE << (channel & np.uint32(7)))
        start = (first + n) * factor - (taps.size >> 1)
        tap = np.uint32(max(np.int64(0), -start))
        end = np.uint32(max(np.int64(0), min(np.int64(taps.size), n_samples - start)))
        at = np.uint32((start + np.int64(tap)) * n_octets + np.int64(channel >> np.uint32(3)))
        step = np.uint32(n_octets)
        while tap < end:
            # Cast to 32 bits at each step, because Numba widens sums of 32-bit integers to 64 bits.
            weight = np.int32(taps[tap])
            above = np.uint8(octets[at] & mask)
            total = np.int32(total + weight) if above else np.int32(total - weight)
            tap = np.uint32(tap + _ONE)
            at = np.uint32(at + step)
    out[mic, n] = np.float32(total) * scale


def demodulate_words(words, channels, taps, scale, factor, first, n_outputs, out):
    """Unpack, decimate and remove the group delay in one pass over the words."""
    octets = words.view(np.uint8)
    n_mics = min(_MICS, 1 << (out.shape[0] - 1).bit_length())
    block = n_mics, _THREADS // n_mics
    grid = -(-out.shape[1] // block[1]), -(-out.shape[0] // block[0])
    launch(
        _sum_taps,
        grid,
        block,
        indexed(octets.reshape(-1)),
        *octets.shape,
        channels,
        taps,
        scale,
        factor,
        first,
        n_outputs,
        out,
    )
