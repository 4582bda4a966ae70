"""Convert signals to the bits of sigma-delta modulators, one per microphone.

Octets of a word are processed in parallel, ten times as fast as one microphone at a time. Noise and dither are a hash
of key and sample index, so that the bits depend neither on threads nor on blocks; fastmath is off.
"""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.lanes import LANES, as_float64, bits, clamp, load, sign, splat, store, turn_octet
from ertis_numba.kernels._scalar import MIX_1, MIX_2, NOISE_UNIT, STEP, TO_GRID

__all__ = ["modulate_pdm"]

_OCTETS = LANES // 8
_INTEGRATORS = 4
_TILE = 256  # samples between two writes of octets: threads that write to the same cache line wait for each other

_12, _24, _27, _30, _31 = np.uint64(12), np.uint64(24), np.uint64(27), np.uint64(30), np.uint64(31)

# The upper 16 bits of a hash yield the dither, and four 12-bit fields the noise.
_TOP_16 = np.uint64(0x000F_FFF0_0000_0000)  # after a right shift by 12: the upper 16 bits of a 52-bit fraction
_FIELDS_0_AND_2 = np.uint64(0x0000_000F_FF00_0FFF)
_LOW_24 = np.uint64(0xFF_FFFF)
_ONE, _TWO_52 = np.uint64(0x3FF0_0000_0000_0000), np.uint64(0x4330_0000_0000_0000)  # 1 and 2⁵² as float64
_DITHER_MEAN = 1.5 - 2.0**-17
_NOISE_MEAN = 2.0**52 + 4 * 4095 / 2


@njit(inline="always")
def _hashed(counter):
    """Return the SplitMix64 hashes of the counters."""
    z = (counter ^ (counter >> splat(_30))) * splat(MIX_1)
    z = (z ^ (z >> splat(_27))) * splat(MIX_2)
    return z ^ (z >> splat(_31))


@njit(inline="always")
def _dither(z):
    """Return the upper 16 bits of a hash as uniform numbers within ±½."""
    return as_float64(((z >> splat(_12)) & splat(_TOP_16)) | splat(_ONE)) - splat(_DITHER_MEAN)


@njit(inline="always")
def _noise(z):
    """Return the sum of the four 12-bit fields of a hash minus its mean."""
    pairs = (z & splat(_FIELDS_0_AND_2)) + ((z >> splat(_12)) & splat(_FIELDS_0_AND_2))
    total = (pairs & splat(_LOW_24)) + (pairs >> splat(_24))
    return as_float64(total | splat(_TWO_52)) - splat(_NOISE_MEAN)


@njit(nogil=True, cache=True)
def _fill_tile(signals, rows, begin, count, tile):
    """Copy ``count`` samples of the lanes' signals to ``tile`` (sample, lane)."""
    whole = count - count % 8
    for n in range(0, whole, 8):
        for octet in range(_OCTETS):
            turn_octet(signals, rows, octet, begin + n, tile, n)
    for lane in range(LANES):
        for n in range(whole, count):
            tile[n, lane] = signals[rows[lane], begin + n]


@njit(nogil=True, cache=True)
def _run(signals, rows, counters, scales, states, loop, octets, masks, out):
    """Modulate the microphones of all lanes, and update ``states`` (integrator, lane)."""
    tile, words = np.empty((_TILE, LANES), np.float64), np.empty(_TILE, np.uint16)
    c1, c2, c3, c4 = splat(loop[0]), splat(loop[1]), splat(loop[2]), splat(loop[3])
    r1, r2, dither, low, high = splat(loop[4]), splat(loop[5]), splat(loop[6]), splat(-loop[7]), splat(loop[7])
    counter, scale = load(counters, 0), load(scales, 0)
    noisy = False
    for lane in range(LANES):
        if scales[0, lane] != 0.0:
            noisy = True
    s1, s2, s3, s4 = load(states, 0), load(states, 1), load(states, 2), load(states, 3)
    for begin in range(0, out.shape[0], _TILE):
        count = min(_TILE, out.shape[0] - begin)
        _fill_tile(signals, rows, begin, count, tile)
        for n in range(count):
            z = _hashed(counter)
            counter = counter + splat(STEP)
            u = load(tile, n)
            if noisy:
                u = u + scale * _noise(z)
            u = (u + splat(TO_GRID)) - splat(TO_GRID)
            quantised = (u + dither * _dither(z)) + ((s1 + s2) + (s3 + s4))
            words[n] = bits(quantised)
            d = u - sign(quantised)
            s1 = clamp(s1 + (c1 * d - r1 * s2), low, high)
            s2 = clamp(s2 + c2 * s1, low, high)
            s3 = clamp(s3 + (c3 * s2 - r2 * s4), low, high)
            s4 = clamp(s4 + c4 * s3, low, high)
        for k in range(_OCTETS):
            for n in range(count):
                out[begin + n, octets[k]] = (words[n] >> (8 * k)) & masks[k]
    store(s1, states, 0)
    store(s2, states, 1)
    store(s3, states, 2)
    store(s4, states, 3)


@njit(nogil=True, cache=True)
def _modulate(signals, mics, keys, noise_rms, states, loop, first, octets, out):
    """Modulate the microphones of the octets that fit in the lanes."""
    rows, counters, masks = np.empty(LANES, np.int64), np.empty((1, LANES), np.uint64), np.empty(_OCTETS, np.int64)
    scales, kept = np.empty((1, LANES)), np.empty((_INTEGRATORS, LANES))
    masks[:] = 0
    for lane in range(LANES):
        mic = mics[octets[lane // 8], lane % 8]
        if mic >= 0:
            masks[lane // 8] |= 1 << lane % 8
        mic = max(mic, 0)  # a lane without a microphone computes the first one, and its bits are masked
        rows[lane] = mic
        counters[0, lane] = keys[mic] + np.uint64(first) * STEP
        scales[0, lane] = noise_rms[mic] * NOISE_UNIT
        for integrator in range(_INTEGRATORS):
            kept[integrator, lane] = states[mic, integrator]
    _run(signals, rows, counters, scales, kept, loop, octets, masks, out)
    for lane in range(LANES):
        if masks[lane // 8] >> lane % 8 & 1:
            for integrator in range(_INTEGRATORS):
                states[rows[lane], integrator] = kept[integrator, lane]


@njit(nogil=True, cache=True)
def _used_octets(mics, out):
    """Return the octets that have a microphone; set the others to 0."""
    used = np.empty(len(mics), np.int64)
    count = 0
    for octet in range(len(mics)):
        has_mic = False
        for mic in mics[octet]:
            has_mic |= mic >= 0
        if has_mic:
            used[count] = octet
            count += 1
        else:
            out[:, octet] = 0
    return used[:count]


@njit(parallel=True, nogil=True, cache=True)
def modulate_pdm(signals, mics, keys, noise_rms, states, loop, first, out):
    """Modulate a block of signals with a loop of up to four integrators, and pack the bits into PDM words."""
    used = _used_octets(mics, out)
    for group in prange((len(used) + _OCTETS - 1) // _OCTETS):
        octets = np.empty(_OCTETS, np.int64)
        for k in range(_OCTETS):
            octets[k] = used[min(group * _OCTETS + k, len(used) - 1)]  # an odd octet is computed twice
        _modulate(signals, mics, keys, noise_rms, states, loop, first, octets, out)
