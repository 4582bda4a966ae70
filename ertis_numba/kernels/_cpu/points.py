# mypy: ignore-errors
"""Points: the image of a single reflector, and maxima interpolated between bins."""

import math

import numpy as np
from numba import njit

from ertis_numba.kernels._contract.points import ABSENT, PointKernels
from ertis_numba.kernels._cpu.echo_fits import fit_echoes
from ertis_numba.kernels._cpu.pulse_table import pulse_at, unit_at

__all__ = ["KERNELS"]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def spread_amplitudes(pulse, path_m, out):
    """Compute the amplitudes of the image of a reflector, relative to that at its place."""
    table, rate_1_m = pulse.table.view(np.float64), 1.0 / pulse.step_m
    for place in range(len(out)):
        here, real, imag = path_m[place], 0.0, 0.0
        for mic in range(len(pulse.weights)):
            a, b = pulse_at(table, rate_1_m, here[mic])
            cosine, sine = unit_at(pulse.carrier_1_m * here[mic])
            real += pulse.weights[mic] * (a * cosine - b * sine)
            imag += pulse.weights[mic] * (a * sine + b * cosine)
        out[place] = math.sqrt(real * real + imag * imag) / len(pulse.weights)


@njit(nogil=True, cache=True, error_model="numpy")
def find_tops(quadrics, fit, rises, out):
    """Find the maxima of quadrics."""
    for place in range(len(out)):
        _top(quadrics, fit[place], rises[place], out[place])


@njit(nogil=True, cache=True, error_model="numpy")
def interpolate_tops(quadrics, fit, logs, out):
    """Interpolate the maxima of the logarithm of an image by parabolas."""
    rises = np.empty(logs.shape[1] - 3)
    for place in range(len(out)):
        level = logs[place, 1]
        absent = level - math.log(2.0)
        before = logs[place, 0] if logs[place, 0] > ABSENT else absent
        after = logs[place, 2] if logs[place, 2] > ABSENT else absent
        for neighbour in range(len(rises)):
            log = logs[place, 3 + neighbour]
            rises[neighbour] = (log if log > ABSENT else absent) - level
        curvature = before - 2.0 * level + after
        out[place, 0] = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
        _top(quadrics, fit[place], rises, out[place, 1:])
        out[place, 4] += level + 0.25 * (after - before) * out[place, 0]


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
def noise_around(amplitude, direction, place, first, n_around, quantiles, fallen, out):
    """Compute the highest quantile of amplitudes in windows around bins."""
    last = amplitude.shape[1] - 1
    around, others = np.empty(n_around, np.float32), np.empty(n_around, np.float32)
    out[:] = 0.0
    for number in range(len(place)):
        row = amplitude[direction[number]]
        for window in range(len(first)):
            for k in range(n_around):
                column = abs(place[number] + first[window] + k)
                around[k] = row[max(last - abs(last - column), 0)]
            begin, end = _slopes(around, min(-first[window], n_around - 1), fallen)
            for q in range(len(quantiles)):
                count = 0
                for k in range(n_around):
                    if not (quantiles[q] > 0.5 and begin <= k < end):
                        others[count] = around[k]
                        count += 1
                if count:
                    out[q, number] = max(out[q, number], _ranked(others, count, int(quantiles[q] * (count - 1))))


@njit(nogil=True, cache=True, error_model="numpy")
def _slopes(around, middle, fallen):
    """Return the begin and the end of the slopes around a place, equal if they are those of noise."""
    begin, end = middle, middle + 1
    while begin > 0 and around[begin - 1] <= around[begin]:
        begin -= 1
    while end < len(around) and around[end] <= around[end - 1]:
        end += 1
    if min(around[begin], around[end - 1]) > fallen * around[middle]:
        return 0, 0
    return begin, end


@njit(nogil=True, cache=True, error_model="numpy")
def _ranked(values, count, rank):
    """Return the value with a rank, after C. A. R. Hoare, Algorithm 65: Find, 1961; their order is lost."""
    first, last = 0, count - 1
    while first < last:
        pivot, i, j = values[(first + last) // 2], first, last
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        first, last = first if rank <= j else i, j if rank <= j else last
        if j < rank < first:
            break
    return values[rank]


@njit(nogil=True, cache=True, fastmath={"contract"})
def encode_levels(bits, floor, per_octave, out):
    """Round levels to codes."""
    low = np.float32(1.5) - (floor + np.float32(127)) * per_octave
    for place in range(len(out)):
        exponent = np.float32(np.uint32(bits[place]) >> np.uint32(23))  # That of negative numbers exceeds 255.
        m = np.float32(bits[place] & np.int32(0x7FFFFF)) * np.float32(2**-23)
        # log2(1 + m) within 4e-4 dB, exact at both ends.
        curve = np.float32(0.44245) + m * (np.float32(-0.27016) + m * (np.float32(0.15202) - np.float32(0.04584) * m))
        log = m + m * (np.float32(1) - m) * curve
        code = low + (exponent + log) * per_octave
        out[place] = np.uint8(np.int32(min(max(code, np.float32(0)), np.float32(255))))


KERNELS = PointKernels(
    spread_amplitudes=spread_amplitudes,
    find_tops=find_tops,
    interpolate_tops=interpolate_tops,
    fit_echoes=fit_echoes,
    noise_around=noise_around,
    encode_levels=encode_levels,
)
