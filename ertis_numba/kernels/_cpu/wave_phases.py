# mypy: ignore-errors
"""Phases of the waves from a tile of directions, which keeps them in the first cache.

A complex product turns them from bin to bin; anew every few bins, so that errors remain below 2e-6.
"""

import numpy as np
from numba import njit

from ertis_numba.kernels._cpu.vectors import REGISTER_BYTES, add_product, load, store, subtract_product
from ertis_numba.kernels._scalar import cosine_and_sine

__all__ = ["LANES", "REGISTERS", "begin_phases", "move_phases"]

REGISTERS = 2
LANES = REGISTERS * REGISTER_BYTES // 4
"""Directions of a tile."""

_TURNED = 16  # bins from one cosine to the next


@njit(nogil=True, cache=True, fastmath={"contract"})
def begin_phases(steps, first, count, number, phases):
    """Fill (mic, part, lane) with the phases of a tile at a bin."""
    for mic in range(steps.shape[0]):
        for lane in range(LANES):
            step = steps[mic, first + min(lane, count - 1)]
            real, imag = cosine_and_sine(np.uint32(np.uint64(step) * np.uint64(number)))
            phases[mic, 0, lane], phases[mic, 1, lane] = real, -imag


@njit(nogil=True, cache=True)
def move_phases(steps, first, count, bins, k, turns, phases):
    """Change the phases from those of the bin before to those of bin ``k``; ``turns`` are those of bin number 1."""
    if k % _TURNED == 0 or bins[k] != bins[k - 1] + np.uint32(1):
        begin_phases(steps, first, count, bins[k], phases)
        return
    for place in range(0, phases.size, 2 * LANES):
        a, b = load(phases, place, REGISTERS), load(phases, place + LANES, REGISTERS)
        c, d = load(turns, place, REGISTERS), load(turns, place + LANES, REGISTERS)
        store(subtract_product(a * c, b, d), phases, place)
        store(add_product(a * d, b, c), phases, place + LANES)
