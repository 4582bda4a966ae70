# mypy: ignore-errors
"""Fits of single echoes to the samples of an image around its maxima."""

import math

import numpy as np
from numba import njit

from ertis_numba.kernels._contract.points import (
    CONVERGED,
    DAMPING,
    DARK,
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
from ertis_numba.kernels._cpu.echo_model import predict, steer

__all__ = ["fit_echoes"]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def fit_echoes(pulse, beams, samples, starts, axes, noise, model, is_focused, scale, out):
    """Fit single echoes to samples of an image."""
    n_samples, n_mics = samples.row.shape[1], len(pulse.weights)
    tables = pulse.table.view(np.float64), pulse.tilted_hz.view(np.float64), 1.0 / pulse.step_m
    positions_m = np.ascontiguousarray(pulse.positions_m.T)
    row, offset_m, amplitude = np.empty(n_samples, np.int64), np.empty(n_samples), np.empty(n_samples)
    value, noises = np.empty((n_samples, 3)), np.empty((n_samples, 2, n_samples))
    beam, own = np.empty((n_samples, 5, n_mics)), np.empty((5, n_mics))
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
        given = tables, positions_m, amplitude[:n], middle, range_m, axes[place], samples.tilt_s[place], noise, scale
        work = value[:n], noises[:n], beam[:n], own, whole[:n], root[:n, :n]
        steer(pulse, beams, row[:n], offset_m, is_focused, given, work)
        error = model
        _minimise(pulse, given, work, error, freedom, starts[place, 0], found[0])
        n_found = 1
        if samples.is_coarse[place] or found[0, 4] > MUCH * freedom:
            for start in range(1, starts.shape[1]):
                misfits[start] = _misfit(pulse, given, work, error, starts[place, start])
            for _ in range(min(N_TRIED, starts.shape[1] - 1)):
                start = 1 + np.argmin(misfits[1:])
                misfits[start] = np.inf
                _minimise(pulse, given, work, error, freedom, starts[place, start], found[n_found])
                n_found += _is_new(found, n_found)
        best = _combined(found, n_found, out[place])
        for _ in range(N_WIDENED):
            excess = out[place, 4] / freedom
            if not excess > TOO_MUCH:
                break
            least = noise / math.exp(found[best, 3])
            error = max(error, 0.3 * least) * math.sqrt(excess)
            _minimise(pulse, given, work, error, freedom, found[best, :4].copy(), found[0])
            best = _combined(found, 1, out[place])
        out[place, 21] = error


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def _minimise(pulse, given, work, model, freedom, start, out):
    """Find a minimum of the misfit by the method of Levenberg and Marquardt, with its covariance."""
    whole = work[-2]
    normal, factor = np.empty((4, 4)), np.empty((4, 4))
    tried, step, gradient = np.empty(4), np.empty(4), np.empty(4)
    now = out[:4]
    now[:] = start
    best = _misfit(pulse, given, work, model, now)
    _normal(whole, normal, gradient)
    damping = DAMPING
    for _ in range(N_ROUNDS):
        size = 0.0
        step[:] = gradient
        factor[:] = normal
        for i in range(4):
            factor[i, i] += damping * normal[i, i] + TINY
        if not _solve(factor, step):
            break
        for i in range(4):
            tried[i] = now[i] + step[i]
            size = max(size, step[i] * step[i] * normal[i, i])
        error = _misfit(pulse, given, work, model, tried)
        if error <= best:
            best = error
            now[:] = tried
            _normal(whole, normal, gradient)
            damping *= 0.1
        else:
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
def _misfit(pulse, given, work, model, at):
    """Whiten the residuals, and their derivatives by the place and the logarithm of the amplitude."""
    _, _, amplitude, _, _, _, _, noise, _ = given
    value, noises, _, _, whole, root = work
    if not abs(at[3]) < MAX_NP:
        return np.inf
    predict(pulse, given, work, at)
    level = math.exp(at[3])
    for sample in range(len(amplitude)):
        own = max(value[sample, 2], DARK)
        mean = math.sqrt(level * level * own * own + RICE * noise * noise)
        ratio = level * level * own / mean
        for i in range(3):
            whole[sample, i] *= ratio
        whole[sample, 3] = ratio * own
        whole[sample, 4] = amplitude[sample] - mean
    for one in range(len(amplitude)):
        for other in range(one + 1):
            real = value[one, 0] * value[other, 0] + value[one, 1] * value[other, 1]
            imag = value[one, 0] * value[other, 1] - value[one, 1] * value[other, 0]
            root[one, other] = 0.5 * noise * noise * (noises[one, 0, other] * real - noises[one, 1, other] * imag)
        root[one, one] += 0.5 * (model * level) ** 2
    if not _cholesky(root):
        return np.inf
    _forward(root, whole)
    total = 0.0
    for sample in range(len(amplitude)):
        total += whole[sample, 4] ** 2
    return total + (at[1] * at[1] + at[2] * at[2]) / (WIDE_RAD * WIDE_RAD)


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
