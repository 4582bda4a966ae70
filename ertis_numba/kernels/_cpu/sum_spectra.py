# mypy: ignore-errors
"""Delay spectra by phase shifts, and sum them over the microphones.

A complex product turns phases from vector to vector, in a fifth of the time of a cosine and a sine.
"""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._cpu.vectors import REGISTER_BYTES, add_product, load, splat, store, subtract_product
from ertis_numba.kernels._scalar import cosine_and_sine

__all__ = ["sum_spectra"]

_LANES = REGISTER_BYTES // 4
_TURNED = 48  # vectors from one cosine to the next; phases drift from the middle of them
_MICS = 4  # microphones at a time
_DIRECTIONS = 8  # directions per block, which share the work arrays; fewer in small images, so that all threads work


@njit(nogil=True, cache=True)
def _unfold(spectrum, first_bin, n_bins, parts):
    """Fill the real and the imaginary parts of the bins of a folded spectrum, (k,) complex64."""
    done = 0
    while done < n_bins:
        # This run of bins does not wrap around, so that the inner loop needs no modulo operation.
        place = (first_bin + done) % len(spectrum)
        run = min(n_bins - done, len(spectrum) - place)
        real, imag, source = parts[0, done : done + run], parts[1, done : done + run], spectrum[place : place + run]
        for b in range(run):
            real[b], imag[b] = source[b].real, source[b].imag
        done += run


@njit(inline="always", cache=True)
def _add(x, y, real, imag, planes, place, width):
    """Return the sums x and y, increased by a product of a spectrum in ``planes`` and a phase."""
    a, b = load(planes, place, 1), load(planes, place + width, 1)
    x = subtract_product(add_product(x, real, a), imag, b)
    y = add_product(add_product(y, real, b), imag, a)
    return x, y


@njit(inline="always", cache=True)
def _turned(real, imag, turn_real, turn_imag):
    """Return the product of two phases."""
    return subtract_product(real * turn_real, imag, turn_imag), add_product(real * turn_imag, imag, turn_real)


@njit(nogil=True, cache=True, fastmath={"contract"})
def _begin(starts, steps, ahead, real, imag):
    """Fill the phases of each microphone, (mic, lane), at the bins from ``ahead`` on."""
    for mic in range(len(starts)):
        start, step = np.uint64(starts[mic]), np.uint64(steps[mic])
        for lane in range(real.shape[1]):
            phase = np.uint32(start + step * np.uint64(ahead + lane))
            real[mic, lane], imag[mic, lane] = cosine_and_sine(phase)


@njit(nogil=True, cache=True)
def _sum_bins(planes, phases, turns, middle, count, step, sums):
    """Add all microphones to the bins of ``count`` vectors, from ``middle`` on with a step of 1, or before it with −1.

    ``planes`` is (mic, part, bin) and ``sums`` is (part, bin). ``phases``, (part, mic, lane), are those of the vector
    ``middle``, and ``turns``, (part, mic), their change to the next vector.
    """
    n_mics, _, width = planes.shape
    lanes, stride, sign = _LANES, 2 * width, np.float32(step)
    for mic in range(0, n_mics, _MICS):
        place, other = mic * lanes, (n_mics + mic) * lanes
        a, b = load(phases, place, 1), load(phases, other, 1)
        c, d = load(phases, place + lanes, 1), load(phases, other + lanes, 1)
        e, f = load(phases, place + 2 * lanes, 1), load(phases, other + 2 * lanes, 1)
        g, h = load(phases, place + 3 * lanes, 1), load(phases, other + 3 * lanes, 1)
        a_turn, b_turn = splat(planes, turns[0, mic], 1), splat(planes, sign * turns[1, mic], 1)
        c_turn, d_turn = splat(planes, turns[0, mic + 1], 1), splat(planes, sign * turns[1, mic + 1], 1)
        e_turn, f_turn = splat(planes, turns[0, mic + 2], 1), splat(planes, sign * turns[1, mic + 2], 1)
        g_turn, h_turn = splat(planes, turns[0, mic + 3], 1), splat(planes, sign * turns[1, mic + 3], 1)
        if step < 0:
            a, b = _turned(a, b, a_turn, b_turn)
            c, d = _turned(c, d, c_turn, d_turn)
            e, f = _turned(e, f, e_turn, f_turn)
            g, h = _turned(g, h, g_turn, h_turn)
        for k in range(count):
            vector = middle + k if step > 0 else middle - 1 - k
            at = vector * lanes
            x, y = load(sums, at, 1), load(sums, width + at, 1)
            at += mic * stride
            x, y = _add(x, y, a, b, planes, at, width)
            a, b = _turned(a, b, a_turn, b_turn)
            x, y = _add(x, y, c, d, planes, at + stride, width)
            c, d = _turned(c, d, c_turn, d_turn)
            x, y = _add(x, y, e, f, planes, at + 2 * stride, width)
            e, f = _turned(e, f, e_turn, f_turn)
            x, y = _add(x, y, g, h, planes, at + 3 * stride, width)
            g, h = _turned(g, h, g_turn, h_turn)
            store(x, sums, vector * lanes)
            store(y, sums, width + vector * lanes)


@njit(nogil=True, cache=True)
def _fold(sums, first_bin, n_bins, out):
    """Add the sums of bins to their places in ``out``, (k,) complex64."""
    out[:] = np.complex64(0)
    done = 0
    while done < n_bins:
        place = (first_bin + done) % len(out)
        run = min(n_bins - done, len(out) - place)
        real, imag, target = sums[0, done : done + run], sums[1, done : done + run], out[place : place + run]
        for b in range(run):
            target[b] = np.complex64(complex(target[b].real + real[b], target[b].imag + imag[b]))
        done += run


@njit(parallel=True, nogil=True, cache=True)
def sum_spectra(spectra, starts, steps, first_bin, n_bins, out):
    """Delay spectra by phase shifts, and sum them over the microphones: one matrix-vector product per bin."""
    n_directions, n_mics = starts.shape
    n_vectors = (n_bins + _LANES - 1) // _LANES
    planes = np.zeros(((n_mics + _MICS - 1) // _MICS * _MICS, 2, n_vectors * _LANES), np.float32)
    for mic in prange(n_mics):
        _unfold(spectra[mic, 0], first_bin, n_bins, planes[mic])
    at_a_time = min(_DIRECTIONS, max(1, n_directions // 16))
    for block in prange((n_directions + at_a_time - 1) // at_a_time):
        # Microphones that only fill a group of four keep a spectrum and phases of 0.
        phases = np.zeros((2, planes.shape[0], _LANES), np.float32)
        turns = np.zeros((2, planes.shape[0]), np.float32)
        sums = np.empty(planes.shape[1:], np.float32)
        for direction in range(block * at_a_time, min((block + 1) * at_a_time, n_directions)):
            for mic in range(n_mics):
                turn = np.uint64(steps[direction, mic]) * np.uint64(_LANES)
                turns[0, mic], turns[1, mic] = cosine_and_sine(turn)
            sums[:] = np.float32(0)
            for first in range(0, n_vectors, _TURNED):
                stop = min(first + _TURNED, n_vectors)
                middle = (first + stop) // 2
                _begin(starts[direction], steps[direction], middle * _LANES, phases[0], phases[1])
                _sum_bins(planes, phases, turns, middle, stop - middle, 1, sums)
                _sum_bins(planes, phases, turns, middle, middle - first, -1, sums)
            _fold(sums, first_bin, n_bins, out[direction, 0])
