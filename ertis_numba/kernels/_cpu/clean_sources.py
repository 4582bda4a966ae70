# mypy: ignore-errors
"""Find the sources of each bin, by subtracting all sound that is coherent with the loudest direction.

One thread computes a bin, and keeps all phases in the second cache: 770 kB for 3000 directions.
"""

import math

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._contract.passive import (
    CLEAN_GROWTH,
    CLEAN_HOLLOW_ROUNDS,
    CLEAN_LOOP_GAIN,
    CLEAN_ROUNDS_PER_MICROPHONE,
)
from ertis_numba.kernels._cpu.vectors import REGISTER_BYTES, add_product, load, splat, store, subtract_product
from ertis_numba.kernels._scalar import cosine_and_sine

__all__ = ["clean_sources"]

_REGISTERS = 2
_LANES = _REGISTERS * REGISTER_BYTES // 4  # directions of a tile
_ZERO, _ONE = np.float32(0), np.float32(1)


@njit(nogil=True, cache=True, fastmath={"contract"})
def _begin(steps, number, phases):
    """Fill (tile, mic, part, lane) with the waves from all directions."""
    n_mics, n_directions = steps.shape
    for tile in range(len(phases)):
        for mic in range(n_mics):
            for lane in range(_LANES):
                step = steps[mic, min(tile * _LANES + lane, n_directions - 1)]
                real, imag = cosine_and_sine(np.uint32(np.uint64(step) * np.uint64(number)))
                phases[tile, mic, 0, lane], phases[tile, mic, 1, lane] = real, -imag


@njit(nogil=True, cache=True)
def _loudest(powers, n_directions):
    place, peak = 0, np.float32(-np.inf)
    for direction in range(n_directions):
        if powers[direction] > peak:
            place, peak = direction, powers[direction]
    return place, peak


@njit(nogil=True, cache=True, fastmath={"contract"})
def _find_component(rest, wave, scale, seen):
    """Fill (part, mic) with ``scale · rest · wave``; the columns of a Hermitian matrix are its conjugate rows."""
    n_mics = rest.shape[1]
    seen[:] = _ZERO
    for j in range(n_mics):
        a, b = wave[0, j] * scale, wave[1, j] * scale
        for i in range(n_mics):
            real, imag = rest[0, j, i], rest[1, j, i]
            seen[0, i] = (seen[0, i] + real * a) + imag * b
            seen[1, i] = (seen[1, i] + real * b) - imag * a


@njit(nogil=True, cache=True, fastmath={"contract"})
def _add_own_power(wave, seen, norm, component):
    """Fill the component of a matrix without its diagonal, given that with it."""
    root = np.float32(math.sqrt(norm))
    component[:] = wave
    for _ in range(CLEAN_HOLLOW_ROUNDS):
        size = _ONE / np.float32(math.sqrt(_ONE + _power_of(component) / norm))
        for i in range(component.shape[1]):
            own = ((component[0, i] * component[0, i]) + component[1, i] * component[1, i]) / root
            component[0, i] = (seen[0, i] + own * wave[0, i]) * size
            component[1, i] = (seen[1, i] + own * wave[1, i]) * size


@njit(nogil=True, cache=True, fastmath={"contract"})
def _power_of(component):
    total = _ZERO
    for i in range(component.shape[1]):
        total = (total + component[0, i] * component[0, i]) + component[1, i] * component[1, i]
    return total


@njit(nogil=True, cache=True, fastmath={"contract"})
def _subtract_matrix(component, share, hollow, rest):
    n_mics = component.shape[1]
    for i in range(n_mics):
        a, b = share * component[0, i], share * component[1, i]
        for j in range(n_mics):
            c, d = component[0, j], component[1, j]
            rest[0, i, j] = (rest[0, i, j] - a * c) - b * d
            rest[1, i, j] = (rest[1, i, j] - b * c) + a * d
        if hollow:
            rest[0, i, i] = rest[1, i, i] = _ZERO


@njit(nogil=True, cache=True)
def _subtract_map(phases, component, scale, own, left):
    """Subtract the map of a component, ``scale · (|v^H c|² − own)``, of parts (part, mic)."""
    n_mics = phases.shape[1]
    for tile in range(len(phases)):
        at = tile * n_mics * 2 * _LANES
        x = splat(left, _ZERO, _REGISTERS)
        y = splat(left, _ZERO, _REGISTERS)
        for mic in range(n_mics):
            real, imag = load(phases, at, _REGISTERS), load(phases, at + _LANES, _REGISTERS)
            a, b = splat(left, component[0, mic], _REGISTERS), splat(left, component[1, mic], _REGISTERS)
            x = add_product(add_product(x, real, a), imag, b)
            y = subtract_product(add_product(y, real, b), imag, a)
            at += 2 * _LANES
        coherent = add_product(add_product(splat(left, -own, _REGISTERS), x, x), y, y)
        before = load(left, tile * _LANES, _REGISTERS)
        store(subtract_product(before, splat(left, scale, _REGISTERS), coherent), left, tile * _LANES)


@njit(nogil=True, cache=True)
def _separate(matrix, hollow, rest):
    """Fill (part, mic, mic) with a matrix, whose diagonal becomes 0 if it is left out."""
    for i in range(len(matrix)):
        for j in range(len(matrix)):
            value = np.complex64(0) if hollow and i == j else matrix[i, j]
            rest[0, i, j], rest[1, i, j] = value.real, value.imag


@njit(nogil=True, cache=True)
def _clean(matrix, steps, number, power, hollow, found):
    """Fill the sources of one bin."""
    n_mics, n_directions = steps.shape
    n_tiles = (n_directions + _LANES - 1) // _LANES
    phases = np.empty((n_tiles, n_mics, 2, _LANES), np.float32)
    _begin(steps, number, phases)
    rest = np.empty((2, n_mics, n_mics), np.float32)
    _separate(matrix, hollow, rest)
    left = np.zeros(n_tiles * _LANES, np.float32)
    left[:n_directions] = power
    found[:] = _ZERO
    peaks = np.empty(CLEAN_ROUNDS_PER_MICROPHONE * n_mics, np.float32)
    wave, seen, component = np.empty((3, 2, n_mics), np.float32)
    norm = np.float32(max(n_mics * n_mics - n_mics, 1) if hollow else n_mics * n_mics)
    for turn in range(len(peaks)):
        place, peak = _loudest(left, n_directions)
        if not peak > _ZERO:
            break
        share = CLEAN_LOOP_GAIN * peak
        found[place] += share
        peaks[turn] = peak
        if turn > CLEAN_GROWTH and peak > peaks[turn - CLEAN_GROWTH]:
            break
        for mic in range(n_mics):
            for part in range(2):
                wave[part, mic] = phases[place // _LANES, mic, part, place % _LANES]
        _find_component(rest, wave, _ONE / (np.float32(math.sqrt(norm)) * peak), seen)
        if hollow:
            _add_own_power(wave, seen, norm, component)
        else:
            component[:] = seen
        _subtract_matrix(component, share, hollow, rest)
        _subtract_map(phases, component, share / norm, _power_of(component) if hollow else _ZERO, left)


@njit(parallel=True, nogil=True, cache=True)
def clean_sources(matrices, steps, bins, powers, hollow, out):
    """Find the sources of each bin, by subtracting all sound that is coherent with the loudest direction."""
    for k in prange(len(bins)):
        _clean(matrices[k], steps, bins[k], powers[k], hollow, out[k])
