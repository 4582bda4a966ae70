"""Convert signals to the bits of sigma-delta modulators, with one thread per microphone.

Products are rounded explicitly: a GPU compiler would fuse them with sums, which changes bits.
"""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.lane import SIMULATED, launch, workspace
from ertis_numba.kernels._scalar import NOISE_UNIT, TO_GRID, dither_of, hash_of, noise_of

__all__ = ["modulate_pdm"]

_MICS = 32  # per block: few, so that the microphones are spread over the GPU
_SAMPLES = 128

if SIMULATED:

    @cuda.jit(device=True)
    def _product(a, b):
        """Return ``a · b``, rounded."""
        return a * b

else:
    from numba.cuda import libdevice

    @cuda.jit(device=True)
    def _product(a, b):
        """Return ``a · b``, rounded."""
        return libdevice.dmul_rn(a, b)


@cuda.jit(device=True)
def _clamp(x, limit):
    return max(min(x, limit), -limit)


@cuda.jit(cache=True)
def _modulate(signals, keys, noise_rms, states, loop, first, above):
    """Fill ``above``, (sample, mic) uint8, with 1 where the quantiser's output is +1."""
    mic = np.uint64(cuda.grid(1))
    if mic >= np.uint64(above.shape[1]):
        return
    c1, c2, c3, c4, r1, r2, width, limit = loop[0], loop[1], loop[2], loop[3], loop[4], loop[5], loop[6], loop[7]
    s1, s2, s3, s4 = states[mic, 0], states[mic, 1], states[mic, 2], states[mic, 3]
    key, scale = keys[mic], noise_rms[mic] * NOISE_UNIT
    for n in range(np.uint64(above.shape[0])):
        z = np.uint64(hash_of(key, np.int64(first + np.int64(n))))
        u = signals[mic, n]
        if scale != 0.0:
            u += _product(scale, noise_of(z))
        u = (u + TO_GRID) - TO_GRID
        quantised = (u + _product(width, dither_of(z))) + ((s1 + s2) + (s3 + s4))
        if quantised >= 0.0:
            above[n, mic] = np.uint8(1)
            d = u - 1.0
        else:
            above[n, mic] = np.uint8(0)
            d = u + 1.0
        s1 = _clamp(s1 + (_product(c1, d) - _product(r1, s2)), limit)
        s2 = _clamp(s2 + _product(c2, s1), limit)
        s3 = _clamp(s3 + (_product(c3, s2) - _product(r2, s4)), limit)
        s4 = _clamp(s4 + _product(c4, s3), limit)
    states[mic, 0], states[mic, 1], states[mic, 2], states[mic, 3] = s1, s2, s3, s4


@cuda.jit(cache=True)
def _pack(above, mics, out):
    sample, octet = np.uint64(cuda.blockIdx.x * _SAMPLES + cuda.threadIdx.x), np.uint64(cuda.blockIdx.y)
    if sample >= np.uint64(out.shape[0]):
        return
    bits = np.uint32(0)
    for place in range(np.uint32(8)):
        mic = mics[octet, place]
        if mic >= np.int32(0):
            bits |= np.uint32(above[sample, np.uint64(mic)]) << np.uint32(place)
    out[sample, octet] = np.uint8(bits)


def modulate_pdm(signals, mics, keys, noise_rms, states, loop, first, out):
    """Modulate a block of signals with a loop of up to four integrators, and pack the bits into PDM words."""
    n_samples, n_octets = out.shape
    n_mics = keys.shape[0]
    above = workspace("bits of modulators", (n_samples, n_mics), np.uint8)
    launch(_modulate, (-(-n_mics // _MICS),), (_MICS,), signals, keys, noise_rms, states, loop, first, above)
    launch(_pack, (-(-n_samples // _SAMPLES), n_octets), (_SAMPLES,), above, mics, out)
