"""Scalar arithmetic, inlined into the kernels that call it and compiled for their device.

Kernels of the CPU and of the GPU share `power`, `magnitude`, `coherence_factor`, `between` and the constants. All other
functions are for the GPU only: complex numbers that take a single load, roots and hashes.

Compilers may fuse a product and a sum. In ``a b + c d`` either product may be fused, with different bits, and on the
CPU the choice varies between compilations. In ``(e + a b) + c d`` both are fused. CPU kernels use the second form:
their bits are the same for a kernel just compiled and for one from Numba's cache. GPU kernels do not need it, because a
single compiler always makes the same code.
"""

import math

import numpy as np
from numba import njit

__all__ = [
    "MIX_1",
    "MIX_2",
    "NOISE_UNIT",
    "STEP",
    "TO_GRID",
    "between",
    "coherence_factor",
    "cosine_and_sine",
    "dither_of",
    "hash_of",
    "imag_of",
    "magnitude",
    "noise_of",
    "power",
    "real_of",
    "root_of",
    "sample_of",
    "short_imag_of",
    "short_real_of",
    "short_sample_of",
    "upper_halves",
]

_LOW_32, _32 = np.uint64(0xFFFF_FFFF), np.uint64(32)
_LOW_16, _16 = np.uint32(0xFFFF), np.uint32(16)
_HALF, _SHIFT = np.int64(1 << 15), np.int64(16)
_1, _2, _3 = np.uint32(1), np.uint32(2), np.uint64(3)
_EIGHTH_TURN, _QUARTER_MASK, _EIGHTH = np.uint64(1 << 29), np.uint64((1 << 30) - 1), np.int32(1 << 29)
_RADIANS = np.float32(2 * math.pi / 2**32)
# Polynomials for angles within ±π/4, from sinf and cosf of the library Cephes (S. L. Moshier).
_SINE = tuple(map(np.float32, (-1.6666654611e-1, 8.3321608736e-3, -1.9515295891e-4)))
_COSINE = tuple(map(np.float32, (4.166664568298827e-2, -1.388731625493765e-3, 2.443315711809948e-5)))
_TO_WHOLE = np.float32(1.5 * 2.0**23)  # float32 of this size are 1 apart: adding it rounds, and ties go to even


# SplitMix64 (G. L. Steele, D. Lea, C. H. Flood, Fast splittable pseudorandom number generators, 2014). The constants
# are variant 13 by D. Stafford, as in the generators of S. Vigna.
STEP = np.uint64(0x9E3779B97F4A7C15)
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)
_12, _24, _27, _30, _31, _36, _48 = (np.uint64(shift) for shift in (12, 24, 27, 30, 31, 36, 48))
_FIELD = np.uint64(0xFFF)  # the lower four 12-bit fields of a hash yield noise, the upper 16 bits dither
NOISE_UNIT = 1 / math.sqrt((4096.0**2 - 1) / 3)
"""1 / RMS of a sum of four integers from 0 to 4095, without its mean."""
TO_GRID = 1.5 * 2.0**32
"""Number at which float64 are 2⁻²⁰ apart: adding it rounds to this grid, on every processor."""


@njit(inline="always", cache=True)
def real_of(sample):
    """Return the real part of a complex64 given as a uint64; a uint64 takes a single load."""
    return np.uint32(sample & _LOW_32).view(np.float32)


@njit(inline="always", cache=True)
def imag_of(sample):
    """Return the imaginary part of a complex64 given as a uint64."""
    return np.uint32(sample >> _32).view(np.float32)


@njit(inline="always", cache=True)
def sample_of(real, imag):
    """Return a complex64 as a uint64."""
    low, high = np.float32(real).view(np.uint32), np.float32(imag).view(np.uint32)
    return np.uint64(low) | (np.uint64(high) << _32)


@njit(inline="always", cache=True)
def short_real_of(sample):
    """Return the real part of a pair of int16 given as a uint32, as an int32."""
    return np.int32(np.int16(sample & _LOW_16))


@njit(inline="always", cache=True)
def short_imag_of(sample):
    """Return the imaginary part of a pair of int16 given as a uint32, as an int32."""
    return np.int32(np.int16(sample >> _16))


@njit(inline="always", cache=True)
def short_sample_of(real, imag):
    """Return two numbers in the range of int16 as a uint32, rounded; ties go to even."""
    low = np.uint32(np.int32((np.float32(real) + _TO_WHOLE) - _TO_WHOLE))
    high = np.uint32(np.int32((np.float32(imag) + _TO_WHOLE) - _TO_WHOLE))
    return np.uint32((low & _LOW_16) | (high << _16))


@njit(inline="always", cache=True)
def upper_halves(real, imag):
    """Return the upper 16 bits of two int32, rounded, as a uint32."""
    low = np.uint32((np.int64(real) + _HALF) >> _SHIFT)
    high = np.uint32((np.int64(imag) + _HALF) >> _SHIFT)
    return np.uint32((low & _LOW_16) | (high << _16))


@njit(inline="always", cache=True)
def power(real, imag):
    """Return ``real² + imag²``."""
    return (np.float32(0) + real * real) + imag * imag


@njit(inline="always", cache=True)
def magnitude(real, imag):
    """Return ``√(real² + imag²)``; `abs` also avoids overflow, but takes ten times as long."""
    return math.sqrt(power(real, imag))


@njit(inline="always", cache=True)
def between(low, high, part):
    """Return the linear interpolation between two numbers at ``part``, from 0 to 1."""
    return low + (high - low) * part


@njit(inline="always", error_model="numpy", cache=True)
def coherence_factor(real, imag, total_power, count):
    """Return the coherence factor of ``count`` numbers from their sum and the sum of their powers."""
    # At most 1, so that rounding errors cannot raise a level, and 0 for zero power. NaN propagates.
    coherent = power(real, imag)
    total = count * total_power
    factor = coherent / total if total != 0 else np.float32(0)
    return min(factor, np.float32(1))


@njit(inline="always", error_model="numpy", cache=True)
def root_of(real, imag, order):
    """Return ``x / |x|^(1 − 1 / order)``, 0 for 0, in single precision; x is scaled to avoid underflow."""
    x, y = abs(real), abs(imag)
    largest = max(x, y)
    scale = np.float32(0)
    if x != 0 or y != 0:
        real, imag = real / largest, imag / largest
        square = power(real, imag)  # from 1 to 2
        if order == 2:  # the usual one
            scale = math.sqrt(largest / math.sqrt(square))
        else:
            exponent = np.float32(1) / np.float32(order)
            scale = largest**exponent * square ** ((exponent - np.float32(1)) * np.float32(0.5))
    return real * scale, imag * scale


@njit(inline="always", cache=True)
def cosine_and_sine(phase):
    """Return the cosine and the sine of a phase in 2⁻³² of a turn, an unsigned integer, of which 32 bits count.

    Only the distance to the nearest quarter turn is converted to a float32, so the error is 1e-7 at any phase.
    """
    moved = np.uint64(phase) + _EIGHTH_TURN
    quarter = np.uint32(moved >> _30 & _3)
    angle = np.float32(np.int32(np.uint32(moved & _QUARTER_MASK)) - _EIGHTH) * _RADIANS
    square = angle * angle
    sine = angle + angle * square * (_SINE[0] + square * (_SINE[1] + square * _SINE[2]))
    cosine = (np.float32(1) - np.float32(0.5) * square) + square * square * (
        _COSINE[0] + square * (_COSINE[1] + square * _COSINE[2])
    )
    is_odd = quarter & _1 != 0
    real, imag = (sine, cosine) if is_odd else (cosine, sine)
    return -real if (quarter + _1) & _2 != 0 else real, -imag if quarter & _2 != 0 else imag


@njit(inline="always", cache=True)
def hash_of(key, sample):
    """Return the SplitMix64 hash of a key and a sample index."""
    z = key + np.uint64(sample) * STEP
    z = (z ^ (z >> _30)) * MIX_1
    z = (z ^ (z >> _27)) * MIX_2
    return z ^ (z >> _31)


@njit(inline="always", cache=True)
def dither_of(z):
    """Return the upper 16 bits of a hash as an exact number within ±½."""
    return (np.float64(z >> _48) - 32_767.5) * 2.0**-16


@njit(inline="always", cache=True)
def noise_of(z):
    """Return the sum of the four lower 12-bit fields of a hash minus its mean."""
    total = (z & _FIELD) + ((z >> _12) & _FIELD) + ((z >> _24) & _FIELD) + ((z >> _36) & _FIELD)
    return np.float64(total) - 8190.0
