"""Reference implementation of peak interpolation by parabolas.

Maxima stay within half of the way to each neighbour, and within the loss of the main lobe there.
"""

import functools
import math

import numpy as np

from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import matched_filter_spectrum

TINY = np.finfo(np.float32).tiny


def interpolated(image, directions, around, direction, range_index):
    """Unit vector, range and amplitude of the maximum near a bin."""
    step_m = image.range_m[1] - image.range_m[0]
    bins = [(direction, range_index + step) for step in (-1, 0, 1)] + [(other, range_index) for other in around]
    measured = np.log(np.maximum([float(image.amplitude[each]) for each in bins], TINY))
    offsets = directions[around] - directions[direction]
    found = parabolas(measured, offsets)
    shift_m = min(0.5, max(-0.5, found[0])) * step_m
    steps = [
        0.5 * offset @ offset / (offset @ found[1]) for offset in offsets if offset @ found[1] > 0.5 * offset @ offset
    ]
    top = directions[direction] + min([1.0, *steps]) * found[1]
    top = top / np.linalg.norm(top)
    lobe = max(0.5, amplitude(image.settings, directions[direction] - top, shift_m))
    highest = min(math.exp(measured[1]) * 10**0.025 / lobe, float(image.amplitude.max()) * 10 ** (0.99 / 20))
    return top, image.range_m[range_index] + shift_m, min(math.exp(found[2]), highest)


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
    """Offset and rise of the maximum of a quadric through samples around 0, or of a parabola at the edge of a grid."""
    none = np.zeros(3), 0.0
    reach = np.max(np.linalg.norm(offsets, axis=1))
    _, sizes, axes = np.linalg.svd(offsets, full_matrices=False)
    if len(offsets) > 5 and sizes[1] > 0.2 * sizes[0] and are_around(offsets @ axes[:2].T):
        x = offsets @ axes[:2].T
        n_axes = 2
    else:
        pair = opposite(offsets)
        if pair is None:
            return none
        axes = np.array([offsets[pair[0]] - offsets[pair[1]]]) / np.linalg.norm(offsets[pair[0]] - offsets[pair[1]])
        x, rises = offsets[pair] @ axes.T, rises[pair]
        n_axes = 1
    columns = [x[:, i] for i in range(n_axes)] + [x[:, i] * x[:, j] for i in range(n_axes) for j in range(i, n_axes)]
    fit = np.linalg.lstsq(np.stack(columns, axis=1), rises, rcond=None)[0]
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


def are_around(places):
    """True if no half-plane is free of neighbours, but for 31 degrees."""
    angles = [math.atan2(y, x) for x, y in places if math.hypot(x, y) > 1e-9]
    return all(min((other - angle) % math.tau or math.tau for other in angles) < 2.6 for angle in angles)


def opposite(offsets):
    """The two nearest neighbours on opposite sides."""
    found = []
    for first, a in enumerate(offsets):
        for second, b in enumerate(offsets[:first]):
            lengths = np.linalg.norm(a), np.linalg.norm(b)
            if min(lengths) > 1e-9 and a @ b < -0.87 * lengths[0] * lengths[1]:
                found.append((sum(lengths), [first, second]))
    return min(found)[1] if found else None


def edge_floor(image, directions):
    """Lowest amplitude of a maximum at each range that cannot be part of an echo beyond the first or last range."""
    samples = np.unique(np.linspace(0, len(directions) - 1, min(len(directions), 64)).astype(int))
    floor = np.zeros(len(image.range_m))
    if len(samples) < 8 or len(floor) < 3:
        return floor
    positions_m = microphones(image.settings.array).enabled_positions_m
    reach_m = 0.04 + max(np.linalg.norm(each) for each in positions_m)
    reach_m = min(reach_m, (image.range_m[-1] - image.range_m[0]) / 4)
    middle = directions[np.argmax(directions @ directions.mean(axis=0))]
    own = np.quantile([amplitude(image.settings, directions[each] - middle, 0.0) for each in samples], 0.75)
    highest = image.amplitude.max(axis=0)
    for place, range_m in enumerate(image.range_m):
        for edge, step in ((0, 1), (-1, -1)):
            if edge == 0 and image.range_m[0] <= image.range_m[1] - image.range_m[0]:
                continue
            offset_m = abs(range_m - image.range_m[edge])
            if offset_m < reach_m:
                floor[place] = max(
                    floor[place], np.quantile(image.amplitude[samples, place], 0.75) * min(0.7 / own, 10)
                )
            offsets_m = np.abs(image.range_m - image.range_m[edge])[::step]
            if offset_m >= 0.1:
                continue
            pulse = np.array([amplitude(image.settings, np.zeros(3), each) for each in offsets_m[offsets_m < 0.1]])
            width, here = int(np.argmax(pulse < 0.18)), int(np.argmin(np.abs(offsets_m - offset_m)))
            last = max(0, min(width, here - width))
            falls = max(0.18, pulse[here - last :].max())
            skirt = highest[::step][: last + 1].max() / (10 ** (3 / 20) * falls)
            floor[place] = math.inf if pulse[here] > 0.65 else max(floor[place], skirt)
    return floor
