"""Compiled kernels of points against NumPy."""

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.kernels import _numpy_points

SETS = {"compiled": kernels.load_points, "numpy": lambda: _numpy_points.KERNELS}
N_MICS, N_PLACES, N_SAMPLES = 12, 40, 9
STEP_M = 0.004


def pulses(draws):
    """Pulse of a flat spectrum, tabulated over differences of paths."""
    path_m = np.arange(4096) * 1e-3
    table = np.sinc(path_m / 0.01) * np.exp(2j * path_m)
    positions_m, weights = draws.normal(scale=0.03, size=(N_MICS, 3)), draws.uniform(0.5, 1.5, N_MICS)
    tilted_hz = -1j * np.gradient(table, 1e-3) * 343.0 / (2 * np.pi)
    return kernels.Pulse(table, tilted_hz, 1e-3, 700.0, positions_m, weights / weights.mean(), 343.0)


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
    pulse = pulses(draws)._replace(table=np.ones(4096, complex))
    away, away_m = draws.normal(scale=0.3, size=(N_PLACES, 3)), draws.normal(scale=0.05, size=N_PLACES)
    path_m = 0.98 * (2 * away_m[:, None] - away @ pulse.positions_m.T)
    exact = np.abs(np.sum(pulse.weights * np.exp(700j * path_m), axis=1)) / N_MICS
    np.testing.assert_allclose(found_by(name, "spread_amplitudes", pulse, path_m, shape=N_PLACES), exact, rtol=1e-9)


def test_amplitudes_are_those_of_numpy_also_beyond_the_table():
    draws = np.random.default_rng(2)
    given = pulses(draws), draws.normal(scale=4.0, size=(N_PLACES, N_MICS))
    compiled, exact = (found_by(name, "spread_amplitudes", *given, shape=N_PLACES) for name in SETS)
    np.testing.assert_allclose(compiled, exact, rtol=1e-9, atol=1e-12)
    assert np.abs(given[1]).max() > 4.1


@pytest.mark.parametrize("name", SETS)
def test_top_is_that_of_the_paraboloid_through_the_values(name):
    draws = np.random.default_rng(3)
    quadrics, beams = grids(draws, beams_have_errors=False)
    x, y = beams.directions[1:, 1:].T / beams.directions[1:, 0]
    tops = np.array([[0.01, -0.02], [0.2, 0.0]])  # The second one is beyond reach.
    values = np.stack([-30 * ((x - a) ** 2 + (y - b) ** 2 - a**2 - b**2) for a, b in tops])
    found = found_by(name, "find_tops", quadrics, np.zeros(2, np.int64), values, shape=(2, 4))
    np.testing.assert_allclose(found, [[0.0, 0.01, -0.02, 30 * 5e-4], [0.0] * 4], atol=1e-9)


def test_interpolated_tops_are_those_of_numpy():
    """Of random samples, and of some without amplitude."""
    draws = np.random.default_rng(4)
    quadrics, _ = grids(draws, beams_have_errors=False)
    amplitude = draws.uniform(0.2, 1.0, (N_PLACES, N_SAMPLES))
    amplitude[:, 1] = 1.1
    amplitude[20:23, 3:5] = 0.0
    logs = np.log(np.maximum(amplitude, np.finfo(np.float32).tiny))
    given = quadrics, draws.integers(0, 2, N_PLACES), logs
    compiled, exact = (found_by(name, "interpolate_tops", *given, shape=(N_PLACES, 5)) for name in SETS)
    np.testing.assert_allclose(compiled, exact, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("is_focused", [False, True])
@pytest.mark.parametrize("beams_have_errors", [False, True])
def test_fitted_echoes_are_those_of_numpy_and_at_their_places(beams_have_errors, is_focused):
    """Single echoes, two at once, noise, and samples without amplitude."""
    draws = np.random.default_rng(5)
    pulse = pulses(draws)
    _, beams = grids(draws, beams_have_errors=beams_have_errors)
    row = np.tile(np.r_[0, 0, 0, 1 : N_SAMPLES - 2], (N_PLACES, 1))
    offset_m = np.zeros((N_PLACES, N_SAMPLES))
    offset_m[:, 0], offset_m[:, 2] = -STEP_M, STEP_M
    axes = np.tile([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], (N_PLACES, 1, 1))
    place = draws.normal(scale=[0.3 * STEP_M, 0.01, 0.01], size=(N_PLACES, 3))
    tilt_s = draws.uniform(-2e-5, 0, N_PLACES)
    amplitude = np.stack(
        [amplitudes(pulse, beams, place[k], offset_m[k], is_focused, tilt_s[k]) for k in range(N_PLACES)]
    )
    amplitude[5:10] += amplitude[10:15]
    amplitude[15:20] *= draws.uniform(0.7, 1.4, (5, N_SAMPLES))
    is_used = np.ones(amplitude.shape, bool)
    is_used[20:23, 3:5] = False
    is_coarse = np.arange(N_PLACES) % 2 == 0
    samples = kernels.EchoSamples(row, is_used, amplitude, offset_m, np.full(N_PLACES, 0.8), is_coarse, tilt_s)
    starts = np.zeros((N_PLACES, 4, 4))
    starts[:, 1:, 1:3] = draws.normal(scale=0.01, size=(N_PLACES, 3, 2))
    given = pulse, beams, samples, starts, axes, 1e-3, 1e-3, is_focused, 1.0
    compiled, exact = (found_by(name, "fit_echoes", *given, shape=(N_PLACES, kernels.N_VALUES)) for name in SETS)
    # Fits end within a hundredth of a standard deviation, and minima that differ by less than a tenth are one.
    single, sd = np.r_[:5, 20:N_PLACES], np.sqrt(exact[:, 5:21:5])
    gaps = np.abs(compiled - exact)[:, :4] / sd
    assert np.median(gaps) < 0.01
    assert (gaps[single] < 0.05).all()
    np.testing.assert_allclose(compiled[single, 4], exact[single, 4], rtol=0.02, atol=0.02)
    np.testing.assert_allclose(np.sqrt(compiled[single, 5:21:5]), sd[single], rtol=0.1)
    np.testing.assert_allclose(compiled[single, :3], place[single], atol=1e-4)
    np.testing.assert_allclose(compiled[single, 3], 0.0, atol=1e-3)
    assert np.median(sd[5:10, 1]) > 3 * np.median(sd[single, 1])  # Two echoes are not the image of one.


def test_noise_around_bins_is_that_of_numpy():
    """Of noise, of echoes with slopes, of clicks, and of bins at both ends of the ranges; all to the bit."""
    draws = np.random.default_rng(6)
    amplitude = draws.rayleigh(size=(7, 120)).astype(np.float32)
    direction, place = draws.integers(0, 7, N_PLACES), np.r_[0, 1, 119, draws.integers(0, 120, N_PLACES - 3)]
    for row, column in zip(direction[::2], place[::2], strict=True):
        amplitude[row] += 500 * np.exp(-np.abs(np.arange(120) - column, dtype=np.float32))
    amplitude[3, 40:60] *= 20
    for n_around in (8, 33, 150):
        first = np.array([1 - n_around, -n_around // 2, 0])
        given = amplitude, direction, place, first, n_around, np.array([0.5, 0.8, 0.0, 1.0]), np.float32(0.01)
        compiled, exact = np.full((2, 4, N_PLACES), np.nan, np.float32)
        kernels.load_points().noise_around(*given, compiled)
        _numpy_points.KERNELS.noise_around(*given, exact)
        np.testing.assert_array_equal(compiled, exact)
        assert np.ptp(compiled, axis=1).min() > 0 or n_around == 150


def amplitudes(pulse, beams, place, offset_m, is_focused, tilt_s, range_m=0.8):
    """Amplitudes of an echo as a sum over microphones, with delays of spherical waves."""

    def lag_m(direction, at_m):
        return np.linalg.norm(at_m * direction - pulse.positions_m, axis=1) - at_m

    top = beams.directions[0] + [0.0, *place[1:]]
    top = top / np.linalg.norm(top)
    found = []
    for direction, away_m in zip(np.r_[0, 0, 0, 1 : N_SAMPLES - 2], offset_m, strict=True):
        ahead = beams.directions[direction]
        expected_m = lag_m(ahead, range_m + away_m) if is_focused else -pulse.positions_m @ ahead
        path_m = 2 * (away_m - place[0]) + expected_m - lag_m(top, range_m + place[0])
        grid_m = pulse.step_m * np.arange(len(pulse.table))
        value, tilted = (
            np.interp(np.abs(path_m), grid_m, table.real)
            + 1j * np.sign(path_m) * np.interp(np.abs(path_m), grid_m, table.imag)
            for table in (pulse.table, pulse.tilted_hz)
        )
        value = value + tilt_s * tilted
        if len(beams.gain):
            value = value * beams.gain[direction] + beams.slope_s[direction] * tilted
        found.append(abs(np.mean(pulse.weights * value * np.exp(1j * pulse.carrier_1_m * path_m))))
    return np.array(found)
