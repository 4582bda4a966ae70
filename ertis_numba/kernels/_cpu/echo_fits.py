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


@njit(nogil=True, cache=True, error_model="numpy")
def fit_echoes(pulse, beams, samples, starts, axes, noise, model, is_focused, scale, out):
    """Fit single echoes to samples of an image."""
    n_samples = samples.row.shape[1]
    value, slopes = np.empty(n_samples, np.complex128), np.empty((n_samples, 3), np.complex128)
    noises = np.empty((n_samples, n_samples), np.complex128)
    lags_m = np.empty((n_samples, len(pulse.weights)))
    whole, root = np.empty((n_samples, 5)), np.empty((n_samples, n_samples))
    work = value, slopes, noises, lags_m, whole, root
    found, misfits = np.empty((N_TRIED + 1, N_VALUES)), np.empty(starts.shape[1])
    for place in range(len(out)):
        row, offset_m = samples.row[place], samples.offset_m[place]
        given = row, samples.is_used[place], samples.amplitude[place], offset_m, samples.range_m[place], axes[place]
        freedom = -4.0 if axes[place, 1].any() else -3.0
        for sample in range(n_samples):
            freedom += samples.is_used[place, sample]
        _steering_lags(pulse, beams.directions, given, is_focused, lags_m)
        _noises(pulse, lags_m, offset_m, scale, noises)
        error = model
        _minimise(pulse, beams, given, work, noise, error, scale, starts[place, 0], found[0])
        n_found = 1
        if samples.is_coarse[place] or found[0, 4] > MUCH * max(freedom, 1.0):
            for start in range(1, starts.shape[1]):
                misfits[start] = _misfit(pulse, beams, given, work, noise, error, scale, starts[place, start])
            for _ in range(min(N_TRIED, starts.shape[1] - 1)):
                start = 1 + np.argmin(misfits[1:])
                misfits[start] = np.inf
                _minimise(pulse, beams, given, work, noise, error, scale, starts[place, start], found[n_found])
                n_found += _is_new(found, n_found)
        best = _combined(found, n_found, out[place])
        for _ in range(N_WIDENED):
            excess = out[place, 4] / max(freedom, 1.0)
            if not excess > TOO_MUCH:
                break
            least = noise / math.exp(found[best, 3])
            error = max(error, 0.3 * least) * math.sqrt(excess)
            _minimise(pulse, beams, given, work, noise, error, scale, found[best, :4].copy(), found[0])
            best = _combined(found, 1, out[place])
        out[place, 21] = error


@njit(nogil=True, cache=True, error_model="numpy")
def _minimise(pulse, beams, given, work, noise, model, scale, start, out):
    """Find a minimum of the misfit by the method of Levenberg and Marquardt, with its covariance."""
    whole = work[4]
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
            if size < CONVERGED * CONVERGED:
                break
        else:
            step[:] = gradient
            damping *= 10.0
            if damping > MAX_DAMPING:
                break
    out[4] = best
    _invert(normal, factor, step, out[5:])


@njit(nogil=True, cache=True, error_model="numpy")
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


@njit(nogil=True, cache=True, error_model="numpy")
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


@njit(nogil=True, cache=True, error_model="numpy")
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


@njit(nogil=True, cache=True, error_model="numpy")
def _steering_lags(pulse, directions, given, is_focused, out):
    """Compute the paths to microphones that beams assume, relative to those to the centre of the array."""
    row, _, _, offset_m, range_m, _ = given
    for sample in range(len(row)):
        x, y, z = directions[row[sample]]
        at_m = range_m + offset_m[sample] if is_focused else 0.0
        for mic in range(len(pulse.weights)):
            out[sample, mic] = _lag_m(pulse, mic, x, y, z, at_m)


@njit(nogil=True, cache=True, error_model="numpy")
def _lag_m(pulse, mic, x, y, z, range_m):
    """Return the path from a place to a microphone minus its range; for a range of 0, that from infinity."""
    p = pulse.positions_m
    along_m = x * p[mic, 0] + y * p[mic, 1] + z * p[mic, 2]
    if range_m <= 0.0:
        return -along_m
    square_m2 = p[mic, 0] * p[mic, 0] + p[mic, 1] * p[mic, 1] + p[mic, 2] * p[mic, 2] - 2.0 * range_m * along_m
    return square_m2 / (math.sqrt(range_m * range_m + square_m2) + range_m)


@njit(nogil=True, cache=True, error_model="numpy")
def _noises(pulse, lags_m, offset_m, scale, out):
    """Compute the correlations of white noise between samples."""
    n_mics = len(pulse.weights)
    total = 0.0
    for mic in range(n_mics):
        total += pulse.weights[mic] * pulse.weights[mic]
    for one in range(len(out)):
        for other in range(one + 1):
            found = 0j
            for mic in range(n_mics):
                path_m = scale * (2.0 * (offset_m[one] - offset_m[other]) + lags_m[one, mic] - lags_m[other, mic])
                before, between = place_of(pulse, path_m)
                weight = pulse.weights[mic]
                found += weight * at_path(pulse.table, before, between, path_m) * carrier_of(pulse, path_m, mic)
            out[one, other] = found / total
            out[other, one] = out[one, other].conjugate()


@njit(nogil=True, cache=True, error_model="numpy")
def _misfit(pulse, beams, given, work, noise, model, scale, at):
    """Whiten the residuals, and their derivatives by the place and the logarithm of the amplitude."""
    row, is_used, amplitude, _, _, _ = given
    value, slopes, noises, _, whole, root = work
    _predict(pulse, beams, given, work, scale, at)
    n_samples, n_mics, level = len(row), len(pulse.weights), math.exp(at[3])
    whole[:] = 0.0
    for sample in range(n_samples):
        if not is_used[sample]:
            continue
        own = max(abs(value[sample]) / n_mics, DARK)
        mean = math.sqrt(level * level * own * own + RICE * noise * noise)
        ratio = level * level * own / mean
        for i in range(3):
            turned = value[sample].conjugate() * slopes[sample, i]
            whole[sample, i] = ratio * turned.real / (own * n_mics * n_mics)
        whole[sample, 3] = ratio * own
        whole[sample, 4] = amplitude[sample] - mean
    for one in range(n_samples):
        for other in range(one + 1):
            root[one, other] = 0.0
            if is_used[one] and is_used[other]:
                turned = noises[one, other] * value[one].conjugate() * value[other]
                size = max(abs(value[one]) * abs(value[other]), TINY)
                root[one, other] = 0.5 * noise * noise * turned.real / size
        root[one, one] += 0.5 * (model * level) ** 2
    if not _cholesky(root):
        return np.inf
    _forward(root, whole)
    total = 0.0
    for sample in range(n_samples):
        total += whole[sample, 4] ** 2
    return total + (at[1] * at[1] + at[2] * at[2]) / (WIDE_RAD * WIDE_RAD)


@njit(nogil=True, cache=True, error_model="numpy")
def _predict(pulse, beams, given, work, scale, at):
    """Compute the sums over microphones for an echo at a place, and their derivatives by the place."""
    row, _, _, offset_m, range_m, axes = given
    value, slopes, _, lags_m, _, _ = work
    top = beams.directions[row[0]] + at[1] * axes[0] + at[2] * axes[1]
    size = math.sqrt(top[0] * top[0] + top[1] * top[1] + top[2] * top[2])
    top /= size
    turn_1_m = 2.0 * math.pi / pulse.speed_m_s
    value[:], slopes[:] = 0j, 0j
    for mic in range(len(pulse.weights)):
        own_m = _lag_m(pulse, mic, top[0], top[1], top[2], max(range_m + at[0], LEAST_M))
        by_1, by_2 = _side(pulse, mic, top, axes[0]) / size, _side(pulse, mic, top, axes[1]) / size
        for sample in range(len(row)):
            path_m = scale * (2.0 * (offset_m[sample] - at[0]) + lags_m[sample, mic] - own_m)
            before, between = place_of(pulse, path_m)
            table, tilted = (
                at_path(pulse.table, before, between, path_m),
                at_path(pulse.tilted_hz, before, between, path_m),
            )
            carrier = scale * carrier_of(pulse, path_m, mic)
            change = 1j * (pulse.carrier_1_m * table + turn_1_m * tilted) * carrier
            if len(beams.gain):
                gain, slope_s = beams.gain[row[sample], mic], beams.slope_s[row[sample], mic]
                table = table * gain + slope_s * tilted
                change = change * gain
            value[sample] += table * carrier / scale
            slopes[sample, 0] -= 2.0 * change
            slopes[sample, 1] += by_1 * change
            slopes[sample, 2] += by_2 * change


@njit(nogil=True, cache=True, error_model="numpy")
def _side(pulse, mic, top, axis):
    """Return the place of a microphone along the part of an axis that is across a direction."""
    p, along_m, length_m, share = pulse.positions_m[mic], 0.0, 0.0, 0.0
    for i in range(3):
        along_m += top[i] * p[i]
        length_m += axis[i] * p[i]
        share += axis[i] * top[i]
    return length_m - share * along_m


@njit(nogil=True, cache=True, error_model="numpy")
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


@njit(nogil=True, cache=True, error_model="numpy")
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


@njit(nogil=True, cache=True, error_model="numpy")
def _forward(root, columns):
    """Solve a triangular system for the first five columns."""
    for i in range(len(root)):
        for column in range(5):
            total = columns[i, column]
            for k in range(i):
                total -= root[i, k] * columns[k, column]
            columns[i, column] = total / root[i, i]


@njit(nogil=True, cache=True, error_model="numpy")
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
