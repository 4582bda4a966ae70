"""Reference implementation of peak interpolation: parabolas, corrected by their error for a point reflector."""

import functools
import math

import numpy as np

from ertis_numba.air import sound_speed_m_s
from ertis_numba.geometry import microphones
from ertis_numba.waveform import matched_filter_spectrum

TINY = np.finfo(np.float32).tiny


def interpolated(image, directions, around, direction, range_index):
    """Unit vector, range and amplitude of the maximum near a bin."""
    step_m = image.range_m[1] - image.range_m[0]
    bins = [(direction, range_index + step) for step in (-1, 0, 1)] + [(other, range_index) for other in around]
    measured = np.log(np.maximum([float(image.amplitude[each]) for each in bins], TINY))
    offsets = directions[around] - directions[direction]
    first = found = parabolas(measured, offsets)
    last = math.inf
    for _ in range(8):
        top = directions[direction] + found[1]
        top, at_m = top / np.linalg.norm(top), image.range_m[range_index] + found[0] * step_m
        predicted = np.array(
            [math.log(amplitude(image.settings, directions[d] - top, image.range_m[r] - at_m)) for d, r in bins]
        )
        predicted += found[2]
        difference = measured - predicted
        if np.max(np.abs(difference - difference[1])) >= 1:
            found = first
            break
        change = [wanted - again for wanted, again in zip(first, parabolas(predicted, offsets), strict=True)]
        size = max(np.max(np.abs(part)) for part in change)
        if size >= last:
            break
        found, last = tuple(now + part for now, part in zip(found, change, strict=True)), size
        if size <= 1e-5:
            break
    if max(abs(found[0] - first[0]), abs(found[2] - first[2])) > 0.5:
        found = first
    top = directions[direction] + found[1]
    return top / np.linalg.norm(top), image.range_m[range_index] + found[0] * step_m, math.exp(found[2])


def amplitude(settings, direction_offset, range_offset_m):
    """Amplitude of a reflector at an offset."""
    wave_1_m, power, positions_m = waves_of(settings)
    waves = np.exp(1j * wave_1_m[:, None] * (2 * range_offset_m - positions_m @ direction_offset))
    return max(1e-6, abs(power @ waves.mean(axis=1)))


@functools.cache
def waves_of(settings):
    """Wave numbers, normalised power spectrum of the call, and microphone positions."""
    n_fft = 2048
    matched = matched_filter_spectrum(settings, n_fft=n_fft)
    frequency_hz = (matched.first_bin + np.arange(len(matched.values))) * settings.signal_rate_hz / n_fft
    power = np.abs(matched.values) ** 2
    positions_m = microphones(settings.array).enabled_positions_m
    return 2 * np.pi * frequency_hz / sound_speed_m_s(settings.air), power / power.sum(), positions_m


def parabolas(logs, offsets):
    """Shift along the range in bins, offset of the direction, and logarithm of the level."""
    before, level, after = logs[:3]
    curvature = before - 2 * level + after
    shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    offset, rise = quadric_top(offsets, logs[3:] - level)
    return shift, offset, level + 0.25 * (after - before) * shift + rise


def quadric_top(offsets, rises):
    """Offset and rise of the maximum of a quadric through samples around 0."""
    none = np.zeros(3), 0.0
    reach = np.max(np.linalg.norm(offsets, axis=1))
    if len(offsets) < 3 or np.linalg.norm(offsets.mean(axis=0)) > 0.25 * reach:
        return none
    _, sizes, axes = np.linalg.svd(offsets, full_matrices=False)
    n_axes = 2 if sizes[1] > 0.2 * sizes[0] else 1
    x = offsets @ axes[:n_axes].T
    columns = [x[:, i] for i in range(n_axes)] + [x[:, i] * x[:, j] for i in range(n_axes) for j in range(i, n_axes)]
    matrix = np.stack(columns, axis=1)
    if len(matrix) <= matrix.shape[1]:
        return none
    fit = np.linalg.lstsq(matrix, rises, rcond=None)[0]
    slope = fit[:n_axes]
    curve = np.zeros((n_axes, n_axes))
    curve[np.triu_indices(n_axes)] = fit[n_axes:]
    curve = curve + curve.T
    if np.max(np.linalg.eigvalsh(curve)) >= 0:
        return none
    top = np.linalg.solve(curve, -slope)
    if np.linalg.norm(top) > reach:
        return none
    return top @ axes[:n_axes], float(0.5 * slope @ top)
