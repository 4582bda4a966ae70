"""Compiled kernels of points against NumPy."""

import math

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.kernels import _numpy_points

SETS = {"compiled": kernels.load_points, "numpy": lambda: _numpy_points.KERNELS}
N_MICS, N_PLACES, N_SAMPLES = 12, 40, 9
STEP_M = 0.004


def pulses(draws):
    """Pulse of a flat spectrum, tabulated over differences of paths, with and without its tilted twin."""
    path_m = np.arange(4096) * 1e-3
    table = np.sinc(path_m / 0.01) * np.exp(2j * path_m)
    positions_m, weights = draws.normal(scale=0.03, size=(N_MICS, 3)), draws.uniform(0.5, 1.5, N_MICS)
    pulse = kernels.Pulse(table, np.empty(0, complex), 1e-3, 700.0, positions_m, weights / weights.mean())
    return pulse, pulse._replace(tilted_hz=3e3 * np.gradient(table))


def grids(draws, beams_have_errors):
    """Directions around an axis, the quadric of each and of its neighbours, and errors of beams."""
    offsets = np.concatenate([np.zeros((1, 2)), draws.normal(scale=0.03, size=(N_SAMPLES - 3, 2))])
    directions = np.column_stack([np.ones(len(offsets)), offsets])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    x, y = offsets[1:].T
    inverse = np.linalg.pinv(np.stack([x, y, x * x, x * y, y * y], axis=1))
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    shape = (len(directions) if beams_have_errors else 0, N_MICS)
    gain, slope_s = (
        (base + scale * (draws.normal(size=shape) + 1j * draws.normal(size=shape))).astype(np.complex64)
        for base, scale in ((1.0, 0.05), (0.0, 1e-6))
    )
    quadrics = kernels.Quadrics(
        np.stack([axes, axes]), np.stack([inverse, inverse]), np.array([2, 1]), np.array([0.1, 0.05])
    )
    return quadrics, kernels.BeamErrors(directions, gain, slope_s)


def found_by(name, kernel, *given, shape):
    out = np.empty(shape)
    getattr(SETS[name](), kernel)(*given, out)
    return out


@pytest.mark.parametrize("name", SETS)
def test_amplitude_is_the_weighted_sum_over_microphones(name):
    """Without a pulse of finite length, it is the pattern of the array for one frequency."""
    draws = np.random.default_rng(1)
    pulse = pulses(draws)[0]._replace(table=np.ones(4096, complex))
    away, away_m = draws.normal(scale=0.3, size=(N_PLACES, 3)), draws.normal(scale=0.05, size=N_PLACES)
    path_m = 0.98 * (2 * away_m[:, None] - away @ pulse.positions_m.T)
    exact = np.abs(np.sum(pulse.weights * np.exp(700j * path_m), axis=1)) / N_MICS
    np.testing.assert_allclose(
        found_by(name, "spread_amplitudes", pulse, away, away_m, 0.98, shape=N_PLACES), exact, rtol=1e-9
    )


def test_amplitudes_are_those_of_numpy_also_beyond_the_table():
    draws = np.random.default_rng(2)
    away, away_m = draws.normal(scale=0.3, size=(N_PLACES, 3)), draws.normal(scale=2.0, size=N_PLACES)
    given = pulses(draws)[0], away, away_m, 1.02
    compiled, exact = (found_by(name, "spread_amplitudes", *given, shape=N_PLACES) for name in SETS)
    np.testing.assert_allclose(compiled, exact, rtol=1e-9, atol=1e-12)
    assert np.abs(2 * away_m).max() > 4.1


@pytest.mark.parametrize("name", SETS)
def test_top_is_that_of_the_paraboloid_through_the_values(name):
    draws = np.random.default_rng(3)
    quadrics, beams = grids(draws, beams_have_errors=False)
    x, y = beams.directions[1:, 1:].T / beams.directions[1:, 0]
    tops = np.array([[0.01, -0.02], [0.2, 0.0]])  # The second one is beyond reach.
    values = np.stack([-30 * ((x - a) ** 2 + (y - b) ** 2 - a**2 - b**2) for a, b in tops])
    found = found_by(name, "find_tops", quadrics, np.zeros(2, np.int64), values, shape=(2, 4))
    np.testing.assert_allclose(found, [[0.0, 0.01, -0.02, 30 * 5e-4], [0.0] * 4], atol=1e-9)


@pytest.mark.parametrize("n_rounds", [0, 8])
@pytest.mark.parametrize("beams_have_errors", [False, True])
def test_interpolated_tops_are_those_of_numpy(n_rounds, beams_have_errors):
    """Samples of single reflectors, of two, of noise, and some without amplitude."""
    draws = np.random.default_rng(4)
    pulse = pulses(draws)[beams_have_errors]
    quadrics, beams = grids(draws, beams_have_errors)
    row = np.tile(np.r_[0, 0, 0, 1 : N_SAMPLES - 2], (N_PLACES, 1))
    offset_m = np.zeros((N_PLACES, N_SAMPLES))
    offset_m[:, 0], offset_m[:, 2] = -STEP_M, STEP_M
    away = beams.directions[row] - beams.directions[0] - 0.01 * draws.normal(size=(N_PLACES, 1, 3))
    given = pulse, away.reshape(-1, 3), (offset_m + 0.3 * STEP_M * draws.normal(size=(N_PLACES, 1))).ravel(), 1.0
    amplitude = found_by("numpy", "spread_amplitudes", *given, shape=N_PLACES * N_SAMPLES).reshape(row.shape)
    amplitude[5:10] += amplitude[10:15]
    amplitude[15:20] *= draws.uniform(0.2, 5.0, (5, N_SAMPLES))
    amplitude[20:23, 3:5] = 0.0
    logs = np.log(np.maximum(amplitude, np.finfo(np.float32).tiny)) + math.log(3)
    fit = draws.integers(0, 2, N_PLACES)
    given = pulse, quadrics, beams, row, fit, logs, offset_m, STEP_M, 1.0, n_rounds
    compiled, exact = (found_by(name, "interpolate_tops", *given, shape=(N_PLACES, 5)) for name in SETS)
    np.testing.assert_allclose(compiled, exact, rtol=1e-6, atol=1e-9)
    uncorrected = found_by("numpy", "interpolate_tops", *given[:-1], 0, shape=(N_PLACES, 5))
    assert np.any(exact != uncorrected) == bool(n_rounds)
