# mypy: ignore-errors
"""Compute streams of analytic signals, and store them in 16 bits in tiles of ranges.

Polynomials vectorise, with errors of 4e-6; functions of the C library would take longer than the beams.
"""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.quantise_tiles import largest_in

__all__ = ["quantise_streams"]

_ZERO = np.float32(0)  # adding it determines which product is fused
_MANTISSA, _UNIT, _EXPONENT = np.int32(0x7FFFFF), np.int32(0x3F800000), np.int32(23)
_BIAS, _LOWEST = np.int32(127), np.float32(-126)
# Coefficients of log₂(1.5 + t) and 2ᵗ for |t| ≤ ½, from interpolation at Chebyshev points.
_LOG = tuple(
    map(np.float32, (0.58496249, 0.96182084, -0.32061303, 0.14172474, -0.070796862, 0.043907471, -0.024568535))
)
_POWER = tuple(map(np.float32, (1.0, 0.69312102, 0.2402235, 0.055921976, 0.0096663684)))


@njit(nogil=True, cache=True)
def _polar(source, inverse, real, imag, logarithm, bits):
    """Fill the direction of each number and log2 of its magnitude times ``inverse``, at least −63; ``bits`` is work."""
    mantissa = bits.view(np.float32)
    for k in range(len(real)):
        x, y = source[2 * k] * inverse, source[2 * k + 1] * inverse
        power = (_ZERO + x * x) + y * y
        root = np.float32(1) / np.sqrt(power) if power > 0 else _ZERO
        real[k], imag[k], mantissa[k] = x * root, y * root, power
    for k in range(len(real)):
        exponent = np.float32((bits[k] >> _EXPONENT) - _BIAS)
        bits[k] = (bits[k] & _MANTISSA) | _UNIT
        logarithm[k] = exponent
    for k in range(len(real)):
        t = mantissa[k] - np.float32(1.5)
        value = _LOG[6]
        value = value * t + _LOG[5]
        value = value * t + _LOG[4]
        value = value * t + _LOG[3]
        value = value * t + _LOG[2]
        value = value * t + _LOG[1]
        value = value * t + _LOG[0]
        logarithm[k] = np.float32(0.5) * max(logarithm[k] + value, _LOWEST)


@njit(nogil=True, cache=True)
def _magnitudes(logarithm, power, limit, magnitude, bits):
    """Fill ``limit · 2^(power · logarithm)``; ``bits`` is a work array of int32."""
    scale = bits.view(np.float32)
    for k in range(len(logarithm)):
        exponent = max(power * logarithm[k], _LOWEST)
        whole = np.int32(exponent - np.float32(0.5))  # Rounds towards zero, so that the rest is within ±½.
        t = exponent - np.float32(whole)
        bits[k] = (whole + _BIAS) << _EXPONENT
        value = _POWER[4]
        value = value * t + _POWER[3]
        value = value * t + _POWER[2]
        value = value * t + _POWER[1]
        magnitude[k] = limit * (value * t + _POWER[0])
    for k in range(len(logarithm)):
        magnitude[k] *= scale[k]


@njit(nogil=True, cache=True)
def _turned(real, imag, turns, magnitude, x, y):
    """Fill x and y with the parts of ``magnitude · direction^turns``."""
    for k in range(len(real)):
        x[k], y[k] = magnitude[k], _ZERO
    for _ in range(turns):
        for k in range(len(real)):
            a, b = x[k], y[k]
            x[k] = (_ZERO + a * real[k]) - b * imag[k]
            y[k] = (_ZERO + a * imag[k]) + b * real[k]


@njit(nogil=True, cache=True)
def _rounded(x, y, target):
    """Fill ``target`` with the rounded numbers (x, y, x, y …), and with 0 beyond the end."""
    for k in range(len(x)):
        target[2 * k] = np.int16(np.rint(x[k]))
        target[2 * k + 1] = np.int16(np.rint(y[k]))
    for k in range(2 * len(x), target.size):
        target[k] = np.int16(0)


@njit(nogil=True, cache=True)
def _plain(power, turns):
    """Return True for y, and for |y|² with |y|, which need neither logarithms nor powers."""
    return power == turns == 1 or (power == 2 and turns == 0)


@njit(nogil=True, cache=True)
def _without_powers(source, inverse, turns, limit, x, y):
    """Fill x and y with the values of a `_plain` stream."""
    if turns == 1:
        factor = inverse * limit
        for k in range(len(x)):
            x[k], y[k] = source[2 * k] * factor, source[2 * k + 1] * factor
        return
    for k in range(len(x)):
        a, b = source[2 * k] * inverse, source[2 * k + 1] * inverse
        power = (_ZERO + a * a) + b * b
        x[k], y[k] = limit * power, limit * np.sqrt(power)


@njit(parallel=True, nogil=True, cache=True)
def quantise_streams(signals, starts, limits, units, powers, turns, first, stop, tiles, scales):
    """Compute streams of analytic signals, and store them like `QuantiseTiles`."""
    n_tiles, n_streams, n_mics, n_phases, width, _ = tiles.shape
    parts = signals.view(np.float32)
    targets = tiles.reshape(n_tiles, n_streams, n_mics, n_phases, 2 * width)
    for tile in prange(n_tiles):
        begin, end = starts[tile], min(starts[tile] + width, signals.shape[2])
        work = np.empty((6, width), np.float32)
        bits = np.empty(width, np.int32)
        largest = largest_in(parts, begin, end, work[0], work[0].view(np.int32))
        for stream in range(first, stop):
            level = np.float64(largest) ** np.float64(powers[stream])
            scales[tile, stream] = np.float32(level / limits[stream] * units[stream])
        inverse = _ZERO if largest == 0 else np.float32(1) / largest
        count = end - begin
        real, imag, logarithm = work[0, :count], work[1, :count], work[2, :count]
        magnitude, x, y = work[3, :count], work[4, :count], work[5, :count]
        needs_polar = False
        for stream in range(first, stop):
            needs_polar |= not _plain(powers[stream], turns[stream])
        for mic in range(n_mics):
            for phase in range(n_phases):
                source = parts[mic, phase, 2 * begin : 2 * end]
                if needs_polar:
                    _polar(source, inverse, real, imag, logarithm, bits)
                for stream in range(first, stop):
                    if _plain(powers[stream], turns[stream]):
                        _without_powers(source, inverse, turns[stream], limits[stream], x, y)
                    else:
                        _magnitudes(logarithm, powers[stream], limits[stream], magnitude, bits)
                        _turned(real, imag, turns[stream], magnitude, x, y)
                    _rounded(x, y, targets[tile, stream, mic, phase])
