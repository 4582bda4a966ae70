# mypy: ignore-errors
"""Rectify real beams, filter them, and keep every factor-th sample."""

import numpy as np
from numba import njit, prange

__all__ = ["rectify_and_decimate"]

_SPAN = 4096  # samples rectified at a time, which stay in the L1 cache
_TOGETHER = 4  # ranges for which each tap is read once


@njit(nogil=True, cache=True, fastmath={"reassoc", "contract", "nsz"})
def _filter_together(magnitude, taps, factor, out):
    """Fill four ranges."""
    second, third, last = magnitude[factor:], magnitude[2 * factor :], magnitude[3 * factor :]
    a = b = c = d = np.float32(0)
    for tap in range(taps.size):
        weight = taps[tap]
        a += weight * magnitude[tap]
        b += weight * second[tap]
        c += weight * third[tap]
        d += weight * last[tap]
    out[0], out[1], out[2], out[3] = a, b, c, d


@njit(parallel=True, nogil=True, cache=True, fastmath={"reassoc", "contract", "nsz"})
def rectify_and_decimate(beams, taps, factor, first, out):
    """Rectify real beams, filter them, and keep every factor-th sample."""
    n_ranges = out.shape[1]
    per_span = max(1, (_SPAN - taps.size) // factor + 1)
    for direction in prange(out.shape[0]):
        magnitude = np.empty((per_span - 1) * factor + taps.size, np.float32)
        for begin in range(0, n_ranges, per_span):
            count = min(per_span, n_ranges - begin)
            start = first + begin * factor
            source = beams[direction, start : start + (count - 1) * factor + taps.size]
            for n in range(source.size):
                magnitude[n] = abs(source[n])
            whole = count // _TOGETHER * _TOGETHER
            for r in range(0, whole, _TOGETHER):
                _filter_together(magnitude[r * factor :], taps, factor, out[direction, begin + r :])
            for r in range(whole, count):
                total = np.float32(0)
                for tap in range(taps.size):
                    total += taps[tap] * magnitude[r * factor + tap]
                out[direction, begin + r] = total
