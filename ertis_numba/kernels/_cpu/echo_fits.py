# mypy: ignore-errors
"""Fits of single echoes to the samples of an image around its maxima."""

import math

import numpy as np
from numba import njit

from ertis_numba.kernels._contract.points import (
    CONVERGED,
    DAMPING,
    DARK,
    LEAST_M,
    MAX_DAMPING,
    MAX_NP,
    MUCH,
    N_ROUNDS,
    N_TRIED,
    N_VALUES,
    N_WIDENED,
    RICE,
    TINY,
    TOO_MUCH,
    WIDE_RAD,
)
from ertis_numba.kernels._cpu.pulse_table import at_path, carrier_of, place_of

__all__ = ["fit_echoes"]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def fit_echoes(pulse, beams, samples, starts, axes, noise, model, is_focused, scale, out):
    """Fit single echoes to samples of an image."""
    n_samples, n_mics = samples.row.shape[1], len(pulse.weights)
    row, offset_m, amplitude = np.empty(n_samples, np.int64), np.empty(n_samples), np.empty(n_samples)
    value, slopes = np.empty(n_samples, np.complex128), np.empty((n_samples, 3), np.complex128)
    noises = np.empty((n_samples, n_samples), np.complex128)
    paths_m, turned = np.empty((n_samples, n_mics)), np.empty((n_samples, n_mics), np.complex128)
    own, sides = np.empty(n_mics, np.complex128), np.empty((n_mics, 3))
    whole, root = np.empty((n_samples, 5)), np.empty((n_samples, n_samples))
    found, misfits = np.empty((N_TRIED + 1, N_VALUES)), np.empty(starts.shape[1])
    for place in range(len(out)):
        n = 0
        for sample in range(n_samples):
            if samples.is_used[place, sample]:
                row[n], offset_m[n] = samples.row[place, sample], samples.offset_m[place, sample]
                amplitude[n] = samples.amplitude[place, sample]
                n += 1
        freedom = max(1.0, n - (4.0 if axes[place, 1].any() else 3.0))
        middle, range_m = beams.directions[samples.row[place, 0]], samples.range_m[place]
        given = row[:n], amplitude[:n], middle, range_m, axes[place], samples.tilt_s[place]
        work = value[:n], slopes[:n], noises[:n, :n], paths_m[:n], turned[:n], own, sides, whole[:n], root[:n, :n]
        _steer(pulse, beams.directions, given, offset_m, is_focused, scale, work)
        error = model
        _minimise(pulse, beams, given, work, noise, error, scale, freedom, starts[place, 0], found[0])
        n_found = 1
        if samples.is_coarse[place] or found[0, 4] > MUCH * freedom:
            for start in range(1, starts.shape[1]):
                misfits[start] = _misfit(pulse, beams, given, work, noise, error, scale, starts[place, start])
            for _ in range(min(N_TRIED, starts.shape[1] - 1)):
                start = 1 + np.argmin(misfits[1:])
                misfits[start] = np.inf
                _minimise(pulse, beams, given, work, noise, error, scale, freedom, starts[place, start], found[n_found])
                n_found += _is_new(found, n_found)
        best = _combined(found, n_found, out[place])
        for _ in range(N_WIDENED):
            excess = out[place, 4] / freedom
            if not excess > TOO_MUCH:
                break
            least = noise / math.exp(found[best, 3])
            error = max(error, 0.3 * least) * math.sqrt(excess)
            _minimise(pulse, beams, given, work, noise, error, scale, freedom, found[best, :4].copy(), found[0])
            best = _combined(found, 1, out[place])
        out[place, 21] = error


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _minimise(pulse, beams, given, work, noise, model, scale, freedom, start, out):
    """Find a minimum of the misfit by the method of Levenberg and Marquardt, with its covariance."""
    whole = work[-2]
    normal, factor = np.empty((4, 4)), np.empty((4, 4))
    tried, step = np.empty(4), np.empty(4)
    now = out[:4]
    now[:] = start
    best = _misfit(pulse, beams, given, work, noise, model, scale, now)
    _normal(whole, normal, step)
    damping = DAMPING
    for _ in range(N_ROUNDS):
        size = 0.0
        gradient = step.copy()
        factor[:] = normal
        for i in range(4):
            factor[i, i] += damping * normal[i, i] + TINY
        if not _solve(factor, step):
            break
        for i in range(4):
            tried[i] = now[i] + step[i]
            size = max(size, step[i] * step[i] * normal[i, i])
        error = _misfit(pulse, beams, given, work, noise, model, scale, tried)
        if error <= best:
            best = error
            now[:] = tried
            _normal(whole, normal, step)
            damping *= 0.1
        else:
            step[:] = gradient
            damping *= 10.0
        if size < CONVERGED * CONVERGED * max(1.0, best / freedom) or damping > MAX_DAMPING:
            break
    out[4] = best
    _invert(normal, factor, step, out[5:])


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _invert(normal, factor, column, out):
    """Compute the covariance from the normal equations; infinite if it does not exist."""
    for i in range(4):
        factor[:] = normal
        for j in range(4):
            factor[j, j] += TINY
        column[:] = 0.0
        column[i] = 1.0
        if not _solve(factor, column):
            column[:] = np.inf
        out[4 * i : 4 * i + 4] = column


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _is_new(found, last):
    """Return 1 if a minimum differs from those before it by more than a tenth of its standard deviations."""
    for other in range(last):
        is_same = True
        for i in range(3):
            gap = found[last, i] - found[other, i]
            is_same = is_same and not gap * gap > 0.01 * found[other, 5 + 5 * i]
        if is_same:
            return 0
    return 1


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _combined(found, n_found, out):
    """Copy the lowest minimum, with the spread of all minima in its covariance, and return its number."""
    best = 0
    for each in range(1, n_found):
        if found[each, 4] < found[best, 4]:
            best = each
    out[:] = found[best]
    total = 0.0
    for each in range(n_found):
        total += math.exp(0.5 * (found[best, 4] - found[each, 4]))
    for each in range(n_found):
        share = math.exp(0.5 * (found[best, 4] - found[each, 4])) / total
        for i in range(4):
            for j in range(4):
                away = (found[each, i] - found[best, i]) * (found[each, j] - found[best, j])
                out[5 + 4 * i + j] += share * away
    return best


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _steer(pulse, directions, given, offset_m, is_focused, scale, work):
    """Compute the paths that beams assume relative to that to the maximum, their carriers, and the noise of samples."""
    row, _, _, range_m, _, _ = given
    _, _, noises, paths_m, turned, _, _, _, _ = work
    for sample in range(len(row)):
        x, y, z = directions[row[sample]]
        at_m = range_m + offset_m[sample] if is_focused else 0.0
        for mic in range(len(pulse.weights)):
            path_m = scale * (2.0 * offset_m[sample] + _lag_m(pulse, mic, x, y, z, at_m))
            paths_m[sample, mic], turned[sample, mic] = path_m, carrier_of(pulse, path_m)
    _noises(pulse, paths_m, turned, noises)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _lag_m(pulse, mic, x, y, z, range_m):
    """Return the path from a place to a microphone minus its range; for a range of 0, that from infinity."""
    p = pulse.positions_m
    along_m = x * p[mic, 0] + y * p[mic, 1] + z * p[mic, 2]
    if range_m <= 0.0:
        return -along_m
    square_m2 = p[mic, 0] * p[mic, 0] + p[mic, 1] * p[mic, 1] + p[mic, 2] * p[mic, 2] - 2.0 * range_m * along_m
    return square_m2 / (math.sqrt(range_m * range_m + square_m2) + range_m)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _noises(pulse, paths_m, turned, out):
    """Compute the correlations of white noise between samples."""
    n_mics = len(pulse.weights)
    total = 0.0
    for mic in range(n_mics):
        total += pulse.weights[mic] * pulse.weights[mic]
    for one in range(len(out)):
        for other in range(one + 1):
            found = 0j
            for mic in range(n_mics):
                path_m = paths_m[one, mic] - paths_m[other, mic]
                before, between = place_of(pulse, path_m)
                carrier = turned[one, mic] * turned[other, mic].conjugate()
                weight = pulse.weights[mic] * pulse.weights[mic]
                found += weight * at_path(pulse.table, before, between, path_m) * carrier
            out[one, other] = found / total
            out[other, one] = out[one, other].conjugate()


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _misfit(pulse, beams, given, work, noise, model, scale, at):
    """Whiten the residuals, and their derivatives by the place and the logarithm of the amplitude."""
    row, amplitude, _, _, _, _ = given
    value, slopes, noises, _, _, _, _, whole, root = work
    if not abs(at[3]) < MAX_NP:
        return np.inf
    _predict(pulse, beams, given, work, scale, at)
    n_mics, level = len(pulse.weights), math.exp(at[3])
    for sample in range(len(row)):
        own = max(abs(value[sample]) / n_mics, DARK)
        mean = math.sqrt(level * level * own * own + RICE * noise * noise)
        ratio = level * level * own / mean
        for i in range(3):
            turned = value[sample].conjugate() * slopes[sample, i]
            whole[sample, i] = ratio * turned.real / (own * n_mics * n_mics)
        whole[sample, 3] = ratio * own
        whole[sample, 4] = amplitude[sample] - mean
    for one in range(len(row)):
        for other in range(one + 1):
            turned = noises[one, other] * value[one].conjugate() * value[other]
            size = max(abs(value[one]) * abs(value[other]), TINY)
            root[one, other] = 0.5 * noise * noise * turned.real / size
        root[one, one] += 0.5 * (model * level) ** 2
    if not _cholesky(root):
        return np.inf
    _forward(root, whole)
    total = 0.0
    for sample in range(len(row)):
        total += whole[sample, 4] ** 2
    return total + (at[1] * at[1] + at[2] * at[2]) / (WIDE_RAD * WIDE_RAD)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _predict(pulse, beams, given, work, scale, at):
    """Compute the sums over microphones for an echo at a place, and their derivatives by the place."""
    row, _, middle, range_m, axes, tilt_s = given
    value, slopes, _, paths_m, turned, own, sides, _, _ = work
    n_mics = len(pulse.weights)
    top = middle + at[1] * axes[0] + at[2] * axes[1]
    size = math.sqrt(top[0] * top[0] + top[1] * top[1] + top[2] * top[2])
    top /= size
    for mic in range(n_mics):
        own_m = _lag_m(pulse, mic, top[0], top[1], top[2], max(range_m + at[0], LEAST_M))
        sides[mic, 0] = scale * (2.0 * at[0] + own_m)
        sides[mic, 1] = _side(pulse, mic, top, axes[0]) / size
        sides[mic, 2] = _side(pulse, mic, top, axes[1]) / size
        # The carrier of a sum of paths is a product: one sine and cosine for all samples.
        own[mic] = pulse.weights[mic] * carrier_of(pulse, -sides[mic, 0])
    carrier_j_m, turn_j_m = 1j * scale * pulse.carrier_1_m, 2j * math.pi * scale / pulse.speed_m_s
    for sample in range(len(row)):
        total = by_range = by_1 = by_2 = 0j
        for mic in range(n_mics):
            path_m = paths_m[sample, mic] - sides[mic, 0]
            before, between = place_of(pulse, path_m)
            carrier = own[mic] * turned[sample, mic]
            table = at_path(pulse.table, before, between, path_m) * carrier
            tilted = at_path(pulse.tilted_hz, before, between, path_m) * carrier
            table += tilt_s * tilted
            change = carrier_j_m * table + turn_j_m * tilted
            if len(beams.gain):
                gain, slope_s = beams.gain[row[sample], mic], beams.slope_s[row[sample], mic]
                table = table * gain + slope_s * tilted
                change = change * gain
            total += table
            by_range += change
            by_1 += sides[mic, 1] * change
            by_2 += sides[mic, 2] * change
        value[sample] = total
        slopes[sample, 0], slopes[sample, 1], slopes[sample, 2] = -2.0 * by_range, by_1, by_2


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _side(pulse, mic, top, axis):
    """Return the place of a microphone along the part of an axis that is across a direction."""
    p, along_m, length_m, share = pulse.positions_m[mic], 0.0, 0.0, 0.0
    for i in range(3):
        along_m += top[i] * p[i]
        length_m += axis[i] * p[i]
        share += axis[i] * top[i]
    return length_m - share * along_m


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _normal(whole, normal, step):
    """Compute the normal equations."""
    for i in range(4):
        step[i] = 0.0
        normal[i] = 0.0
        for sample in range(len(whole)):
            step[i] += whole[sample, i] * whole[sample, 4]
            for j in range(4):
                normal[i, j] += whole[sample, i] * whole[sample, j]
    for i in range(1, 3):
        normal[i, i] += 1.0 / (WIDE_RAD * WIDE_RAD)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _cholesky(matrix):
    """Replace the lower triangle of a matrix by its Cholesky factor; return False if it is not positive."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                matrix[i, i] = math.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    return True


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _forward(root, columns):
    """Solve a triangular system for the first five columns."""
    for i in range(len(root)):
        for column in range(5):
            total = columns[i, column]
            for k in range(i):
                total -= root[i, k] * columns[k, column]
            columns[i, column] = total / root[i, i]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _solve(matrix, vector):
    """Replace a vector by the solution of a positive system."""
    if not _cholesky(matrix):
        return False
    for i in range(len(vector)):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(len(vector) - 1, -1, -1):
        for k in range(i + 1, len(vector)):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]
    return True
