# mypy: ignore-errors
"""Values of the tabulated pulse at differences of paths, without branches, so that loops are vectors."""

import math

import numpy as np
from numba import njit

__all__ = ["pulse_at", "unit_at"]

_HALVED = 3  # Angles are divided by two so often, for which the series below is exact.


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def pulse_at(table, rate_1_m, path_m):
    """Interpolate a table of ``rate_1_m`` entries per metre."""
    last = np.int32(len(table) // 2 - 2)
    place = min(abs(path_m) * rate_1_m, last + 1.0)
    # An index that may be negative would count from the end.
    before = min(np.int32(place), last)
    entry, between = np.uint64(2 * before), place - before
    real = table[entry] + between * (table[entry + np.uint64(2)] - table[entry])
    imag = table[entry + np.uint64(1)] + between * (table[entry + np.uint64(3)] - table[entry + np.uint64(1)])
    return real, math.copysign(1.0, path_m) * imag


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def unit_at(phase):
    """Return cosine and sine; those of the library are not vectors."""
    angle = (phase - 2 * math.pi * math.floor(phase / (2 * math.pi) + 0.5)) / 2**_HALVED
    x = angle * angle
    sine = angle * (1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110 * (1 - x / 156))))))
    cosine = 1 - x / 2 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90 * (1 - x / 132)))))
    for _ in range(_HALVED):
        cosine, sine = cosine * cosine - sine * sine, 2 * cosine * sine
    return cosine, sine
