# mypy: ignore-errors
"""Values of the tabulated pulse at differences of paths."""

import math

from numba import njit

__all__ = ["at_path", "carrier_of", "place_of"]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def place_of(pulse, path_m):
    """Return the entry of the table before a difference of paths, and the distance from it."""
    place = min(abs(path_m) / pulse.step_m, len(pulse.table) - 1.0)
    before = min(int(place), len(pulse.table) - 2)
    return before, place - before


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def at_path(table, before, between, path_m):
    value = table[before] + between * (table[before + 1] - table[before])
    return value.conjugate() if path_m < 0.0 else value


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def carrier_of(pulse, path_m):
    phase = pulse.carrier_1_m * path_m
    return complex(math.cos(phase), math.sin(phase))
