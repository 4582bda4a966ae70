# mypy: ignore-errors
"""Points: the image of a single reflector, and maxima interpolated between bins."""

import math

import numpy as np
from numba import njit

from ertis_numba.kernels._contract.points import ABSENT, ALIKE, CONVERGED, DARK, MAX_SHIFT, PointKernels

__all__ = ["KERNELS"]


@njit(nogil=True, cache=True, error_model="numpy")
def spread_amplitudes(pulse, direction_offset, offset_m, scale, out):
    """Compute the amplitudes of the image of a reflector, relative to that at its place."""
    for place in range(len(out)):
        total = 0j
        for mic in range(len(pulse.weights)):
            path_m = _path_m(pulse, direction_offset[place], offset_m[place], scale, mic)
            before, between = _place(pulse, path_m)
            total += _at(pulse.table, before, between, path_m) * _carrier(pulse, path_m, mic)
        out[place] = abs(total) / len(pulse.weights)


@njit(nogil=True, cache=True, error_model="numpy")
def find_tops(quadrics, fit, rises, out):
    """Find the maxima of quadrics."""
    for place in range(len(out)):
        _top(quadrics, fit[place], rises[place], out[place])


@njit(nogil=True, cache=True, error_model="numpy")
def interpolate_tops(pulse, quadrics, beams, row, fit, logs, offset_m, step_m, scale, n_rounds, out):
    """Interpolate the maxima of the logarithm of an image, and subtract the error of this interpolation."""
    n_samples = logs.shape[1]
    rises, predicted = np.empty(n_samples - 3), np.empty(n_samples)
    here, found = np.empty(5), np.empty(5)
    for place in range(len(out)):
        first = out[place]
        _interpolate(quadrics, fit[place], logs[place], rises, first)
        here[:] = first
        last = np.inf
        for _ in range(n_rounds):
            _predict(pulse, beams, row[place], offset_m[place], step_m, scale, here, predicted)
            if not _is_alike(logs[place], predicted):
                here[:] = first
                break
            _interpolate(quadrics, fit[place], predicted, rises, found)
            size = 0.0
            for i in range(5):
                size = max(size, abs(first[i] - found[i]))
            if not size < last:  # The corrections of noise need not converge.
                break
            for i in range(5):
                here[i] += first[i] - found[i]
            last = size
            if size <= CONVERGED:
                break
        if abs(here[0] - first[0]) <= MAX_SHIFT and abs(here[4] - first[4]) <= MAX_SHIFT:
            first[:] = here


@njit(nogil=True, cache=True, error_model="numpy")
def _interpolate(quadrics, fit, logs, rises, out):
    """Interpolate one maximum by parabolas through logarithms."""
    level = logs[1]
    absent = level - math.log(2.0)
    before, after = logs[0] if logs[0] > ABSENT else absent, logs[2] if logs[2] > ABSENT else absent
    for neighbour in range(len(rises)):
        log = logs[3 + neighbour]
        rises[neighbour] = (log if log > ABSENT else absent) - level
    curvature = before - 2.0 * level + after
    out[0] = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    _top(quadrics, fit, rises, out[1:])
    out[4] += level + 0.25 * (after - before) * out[0]


@njit(nogil=True, cache=True, error_model="numpy")
def _top(quadrics, fit, rises, out):
    """Find the maximum of one quadric."""
    terms = np.zeros(5)
    for term in range(5):
        for neighbour in range(len(rises)):
            terms[term] += quadrics.inverse[fit, term, neighbour] * rises[neighbour]
    slope_x, slope_y, xx, xy, yy = terms
    xx, yy = 2.0 * xx, 2.0 * yy if quadrics.n_axes[fit] == 2 else -1.0
    determinant = xx * yy - xy * xy
    x = y = 0.0
    if xx < 0.0 and determinant > 0.0:
        scale = 1.0 / determinant
        x, y = (xy * slope_y - yy * slope_x) * scale, (xy * slope_x - xx * slope_y) * scale
        if not math.hypot(x, y) <= quadrics.reach[fit]:
            x = y = 0.0
    for axis in range(3):
        out[axis] = x * quadrics.axes[fit, 0, axis] + y * quadrics.axes[fit, 1, axis]
    out[3] = 0.5 * (slope_x * x + slope_y * y)


@njit(nogil=True, cache=True, error_model="numpy")
def _predict(pulse, beams, row, offset_m, step_m, scale, found, out):
    """Predict the logarithms of the samples of a reflector."""
    top, away = np.empty(3), np.empty(3)
    for axis in range(3):
        top[axis] = beams.directions[row[0], axis] + found[1 + axis]
    top /= math.sqrt(top[0] * top[0] + top[1] * top[1] + top[2] * top[2])
    for sample in range(len(out)):
        direction = row[sample]
        for axis in range(3):
            away[axis] = beams.directions[direction, axis] - top[axis]
        away_m = offset_m[sample] - step_m * found[0]
        total = 0j
        for mic in range(len(pulse.weights)):
            path_m = _path_m(pulse, away, away_m, scale, mic)
            before, between = _place(pulse, path_m)
            value = _at(pulse.table, before, between, path_m)
            if len(beams.gain):
                tilted = _at(pulse.tilted_hz, before, between, path_m)
                value = value * beams.gain[direction, mic] + beams.slope_s[direction, mic] * tilted
            total += value * _carrier(pulse, path_m, mic)
        out[sample] = math.log(max(abs(total) / len(pulse.weights), DARK)) + found[4]


@njit(nogil=True, cache=True, error_model="numpy")
def _is_alike(logs, predicted):
    """Return True if samples match those of a single reflector."""
    middle = logs[1] - predicted[1]
    for sample in range(len(logs)):  # noqa: SIM110  Numba has no generators in `all`
        if not abs(logs[sample] - predicted[sample] - middle) < ALIKE:
            return False
    return True


@njit(nogil=True, cache=True, error_model="numpy")
def _path_m(pulse, direction_offset, offset_m, scale, mic):
    along_m = 0.0
    for axis in range(3):
        along_m += direction_offset[axis] * pulse.positions_m[mic, axis]
    return scale * (2.0 * offset_m - along_m)


@njit(nogil=True, cache=True, error_model="numpy")
def _place(pulse, path_m):
    """Return the entry of the table before a difference of paths, and the distance from it."""
    place = min(abs(path_m) / pulse.step_m, len(pulse.table) - 1.0)
    before = min(int(place), len(pulse.table) - 2)
    return before, place - before


@njit(nogil=True, cache=True, error_model="numpy")
def _at(table, before, between, path_m):
    value = table[before] + between * (table[before + 1] - table[before])
    return value.conjugate() if path_m < 0.0 else value


@njit(nogil=True, cache=True, error_model="numpy")
def _carrier(pulse, path_m, mic):
    phase = pulse.carrier_1_m * path_m
    return complex(math.cos(phase), math.sin(phase)) * pulse.weights[mic]


KERNELS = PointKernels(spread_amplitudes=spread_amplitudes, find_tops=find_tops, interpolate_tops=interpolate_tops)
