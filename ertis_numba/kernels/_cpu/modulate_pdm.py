"""Turn signals into the bits of sigma-delta modulators, one per microphone.

Recursive in time, so microphones run side by side and each keeps its state in registers. The dither
is a hash of the microphone's key and the number of the sample, not a stream: neither the number of
threads nor the cut into blocks changes a bit. No fastmath, for the same reason.
"""

import numpy as np
from numba import njit, prange

__all__ = ["modulate_pdm"]

# SplitMix64 (G. L. Steele, D. Lea, C. H. Flood, Fast splittable pseudorandom number generators, 2014)
_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_UNIT = 2.0**-53


@njit(inline="always")
def _dither(key, sample):
    """Return a number in [−½, ½) that only key and sample decide."""
    z = key + np.uint64(sample) * _STEP
    z = (z ^ (z >> _30)) * _MIX_1
    z = (z ^ (z >> _27)) * _MIX_2
    z = z ^ (z >> _31)
    return np.int64(z >> _11) * _UNIT - 0.5


@njit(parallel=True, nogil=True, cache=True)
def modulate_pdm(signals, keys, states, gains, first, dither, limit, out):
    """See `ModulatePdm`."""
    c1, c2, c3, c4, r1, r2 = gains[0], gains[1], gains[2], gains[3], gains[4], gains[5]
    for mic in prange(signals.shape[0]):
        s1, s2, s3, s4 = states[mic, 0], states[mic, 1], states[mic, 2], states[mic, 3]
        key = keys[mic]
        for sample in range(signals.shape[1]):
            u = signals[mic, sample]
            above = (u + dither * _dither(key, first + sample)) + ((s1 + s2) + (s3 + s4)) >= 0.0
            out[mic, sample] = above
            d = u - (1.0 if above else -1.0)
            s1 = min(max(s1 + (c1 * d - r1 * s2), -limit), limit)
            s2 = min(max(s2 + c2 * s1, -limit), limit)
            s3 = min(max(s3 + (c3 * s2 - r2 * s4), -limit), limit)
            s4 = min(max(s4 + c4 * s3, -limit), limit)
        states[mic, 0], states[mic, 1], states[mic, 2], states[mic, 3] = s1, s2, s3, s4
