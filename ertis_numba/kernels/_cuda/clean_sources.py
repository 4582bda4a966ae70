# mypy: ignore-errors
"""Find the sources of each bin, by subtracting all sound that is coherent with the loudest direction.

A round has five launches, because each step needs the results of all threads of the step before.
"""

import math

import numpy as np
from numba import cuda

from ertis_numba.kernels._contract.passive import (
    CLEAN_GROWTH,
    CLEAN_HOLLOW_ROUNDS,
    CLEAN_LOOP_GAIN,
    CLEAN_ROUNDS_PER_MICROPHONE,
)
from ertis_numba.kernels._cuda.lane import launch, workspace
from ertis_numba.kernels._scalar import cosine_and_sine, imag_of, real_of, sample_of

__all__ = ["clean_sources"]

_BLOCK = 128
_ZERO, _ONE, _NOTHING = np.float32(0), np.float32(1), np.uint64(0)
_32, _LAST = np.uint64(32), np.uint64(2**32 - 1)
_ENDED = np.int32(-1)


@cuda.jit(cache=True)
def _begin(matrices, steps, bins, powers, hollow, rests, lefts, phases, components, shares, loudest, out):
    """Set the initial rest, map, waves and sources of each bin, and components of 0."""
    k, thread = cuda.blockIdx.y, cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x
    n_mics, n_directions = steps.shape
    if thread < n_directions:
        number = np.uint64(bins[k])
        for mic in range(n_mics):
            real, imag = cosine_and_sine(np.uint32(np.uint64(steps[mic, thread]) * number))
            phases[k, mic, thread] = sample_of(real, -imag)
        lefts[k, thread] = powers[k, thread]
        out[k, thread] = _ZERO
    if thread < n_mics:
        components[k, 0, thread] = loudest[k] = _NOTHING
        shares[k, 0] = shares[k, 1] = _ZERO
        for j in range(n_mics):
            rests[k, thread, j] = _NOTHING if hollow and thread == j else matrices[k, thread, j]


@cuda.jit(cache=True)
def _subtract_map(phases, components, shares, norm, lefts, loudest):
    """Subtract the map of a component, a thread per direction, and find the largest power of each bin.

    ``loudest`` holds the bits of that power, whose order is that of positive numbers, above the bits of 2³² − 1 minus
    its direction. Of equal powers, the largest number is therefore that of the first direction.
    """
    k, direction = cuda.blockIdx.y, cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x
    if direction >= lefts.shape[1]:
        return
    scale, own = shares[k, 0] / norm, shares[k, 1]
    x, y = _ZERO, _ZERO
    for mic in range(phases.shape[1]):
        phase, value = phases[k, mic, direction], components[k, 0, mic]
        a, b, c, d = real_of(phase), imag_of(phase), real_of(value), imag_of(value)
        x += a * c + b * d
        y += a * d - b * c
    left = np.float32(lefts[k, direction] - scale * (x * x + y * y - own))
    lefts[k, direction] = left
    if left > _ZERO:
        cuda.atomic.max(loudest, k, (np.uint64(left.view(np.uint32)) << _32) | (_LAST - np.uint64(direction)))


@cuda.jit(cache=True)
def _choose(loudest, turn, peaks, chosen, shares, out):
    """Choose the loudest direction of each bin, or end it."""
    k = cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x
    if k >= len(chosen) or (turn > 0 and chosen[k] == _ENDED):
        return
    found, loudest[k] = loudest[k], _NOTHING
    chosen[k], shares[k, 0] = _ENDED, _ZERO
    if found != _NOTHING:
        peak, direction = np.uint32(found >> _32).view(np.float32), np.int32(_LAST - (found & _LAST))
        share = CLEAN_LOOP_GAIN * peak
        out[k, direction] += share
        peaks[k, turn] = peak
        if turn <= CLEAN_GROWTH or not peak > peaks[k, turn - CLEAN_GROWTH]:
            chosen[k], shares[k, 0] = direction, share


@cuda.jit(cache=True)
def _find_component(rests, phases, chosen, turn, peaks, root, hollow, components):
    """Set the component of a matrix with its diagonal, and the initial value of one without it."""
    k, i = cuda.blockIdx.y, cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x
    n_mics, loudest = rests.shape[1], chosen[k]
    if i >= n_mics or loudest == _ENDED:
        return
    scale, x, y = _ONE / (root * peaks[k, turn]), _ZERO, _ZERO
    for j in range(n_mics):
        element, phase = rests[k, i, j], phases[k, j, loudest]
        a, b, c, d = real_of(element), imag_of(element), real_of(phase), imag_of(phase)
        x += a * c - b * d
        y += a * d + b * c
    seen = sample_of(x * scale, y * scale)
    components[k, 0, i] = phases[k, i, loudest] if hollow else seen
    components[k, 1, i] = seen


@cuda.jit(cache=True)
def _add_own_power(phases, chosen, norm, root, components, shares):
    """Set the component of each matrix without its diagonal, and the sum of its powers."""
    k = cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x
    if k >= len(chosen) or chosen[k] == _ENDED:
        return
    n_mics, loudest, total = phases.shape[1], chosen[k], np.float32(phases.shape[1])
    for _ in range(CLEAN_HOLLOW_ROUNDS):
        size, total = _ONE / math.sqrt(_ONE + total / norm), _ZERO
        for i in range(n_mics):
            value, seen, phase = components[k, 0, i], components[k, 1, i], phases[k, i, loudest]
            own = (real_of(value) * real_of(value) + imag_of(value) * imag_of(value)) / root
            real = (real_of(seen) + own * real_of(phase)) * size
            imag = (imag_of(seen) + own * imag_of(phase)) * size
            components[k, 0, i] = sample_of(real, imag)
            total += real * real + imag * imag
    shares[k, 1] = total


@cuda.jit(cache=True)
def _subtract_matrix(components, chosen, shares, hollow, rests):
    k, place = cuda.blockIdx.y, cuda.blockIdx.x * _BLOCK + cuda.threadIdx.x
    n_mics = rests.shape[1]
    if place >= n_mics * n_mics or chosen[k] == _ENDED:
        return
    i, j = place // n_mics, place % n_mics
    element, first, second = rests[k, i, j], components[k, 0, i], components[k, 0, j]
    a, b, c, d = real_of(first), imag_of(first), real_of(second), imag_of(second)
    real, imag = real_of(element) - shares[k, 0] * (a * c + b * d), imag_of(element) - shares[k, 0] * (b * c - a * d)
    rests[k, i, j] = _NOTHING if hollow and i == j else sample_of(real, imag)


def clean_sources(matrices, steps, bins, powers, hollow, out):
    """Find the sources of each bin, by subtracting all sound that is coherent with the loudest direction."""
    n_bins, n_mics, _ = matrices.shape
    n_rounds = CLEAN_ROUNDS_PER_MICROPHONE * n_mics
    norm = np.float32(max(n_mics * n_mics - n_mics, 1) if hollow else n_mics * n_mics)
    root = np.float32(math.sqrt(norm))
    rests = workspace("clean_sources rests", matrices.shape, np.uint64)
    lefts = workspace("clean_sources lefts", out.shape, np.float32)
    phases = workspace("clean_sources phases", (n_bins, *steps.shape), np.uint64)
    components = workspace("clean_sources components", (n_bins, 2, n_mics), np.uint64)
    loudest = workspace("clean_sources loudest", (n_bins,), np.uint64)
    peaks = workspace("clean_sources peaks", (n_bins, n_rounds), np.float32)
    chosen = workspace("clean_sources chosen", (n_bins,), np.int32)
    shares = workspace("clean_sources shares", (n_bins, 2), np.float32)

    def blocks(count):
        return -(-count // _BLOCK)

    block, of_bins = (_BLOCK,), (blocks(n_bins),)
    arguments = matrices.view(np.uint64), steps, bins, powers, hollow, rests, lefts, phases, components, shares
    launch(_begin, (blocks(max(out.shape[1], n_mics)), n_bins), block, *arguments, loudest, out)
    for turn in range(n_rounds):
        of_directions = blocks(out.shape[1]), n_bins
        launch(_subtract_map, of_directions, block, phases, components, shares, norm, lefts, loudest)
        launch(_choose, of_bins, block, loudest, turn, peaks, chosen, shares, out)
        arguments = rests, phases, chosen, turn, peaks, root, hollow, components
        launch(_find_component, (blocks(n_mics), n_bins), block, *arguments)
        if hollow:
            launch(_add_own_power, of_bins, block, phases, chosen, norm, root, components, shares)
        launch(_subtract_matrix, (blocks(n_mics * n_mics), n_bins), block, components, chosen, shares, hollow, rests)
