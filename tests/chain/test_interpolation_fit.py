"""Fitted weights: their error is minimal and predicted, and falls with oversampling."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

from ertis_numba.chain.interpolation_fit import DelayFit, Spectrum, fit, weights_of
from ertis_numba.geometry.waveform import matched_noise_spectrum
from ertis_numba.settings import Call, Settings
from tests.textbook_weights import TEXTBOOK, fitted_error, textbook_error

RATE_HZ = 45_000.0  # of the default ranges
FLOOR = 1e-12  # power by which the fit is regularised
calls = st.builds(
    Call,
    start_frequency_hz=st.floats(30e3, 90e3),
    stop_frequency_hz=st.floats(10e3, 29e3),
    duration_s=st.floats(3e-4, 5e-3),
    ramp_fraction=st.floats(0, 0.5),
)
rates = st.floats(1.8, 50.0)  # by the bandwidth; plans have 1.8 and more


def spectrum_of(call):
    return Spectrum(*matched_noise_spectrum(Settings(call=call), n_waves=40))


def step_s_of(call, rate):
    return 1 / (rate * (call.high_frequency_hz - call.low_frequency_hz))


DEFAULT = spectrum_of(Call())


def errors_db(error, which):
    return np.array([10 * np.log10(error(DEFAULT, 1 / (RATE_HZ * oversampling), which)) for oversampling in (4, 8, 16)])


@settings(max_examples=40, deadline=None)
@given(call=calls, rate=rates, other=st.sampled_from(list(TEXTBOOK)))
def test_fitted_weights_have_the_smallest_error_for_their_taps(call, rate, other):
    spectrum, step_s = spectrum_of(call), step_s_of(call, rate)
    fitted = fitted_error(spectrum, step_s, TEXTBOOK[other][0])
    assert fitted <= textbook_error(spectrum, step_s, other) * (1 + 1e-9) + FLOOR


@settings(max_examples=40, deadline=None)
@given(call=calls, rate=rates, n_taps=st.integers(1, 4))
def test_additional_tap_does_not_raise_the_error(call, rate, n_taps):
    """Half a decibel is permitted: the iterations of the fit end slightly before the minimum."""
    spectrum, step_s = spectrum_of(call), step_s_of(call, rate)
    few, many = (DelayFit(count, step_s, spectrum) for count in (n_taps, n_taps + 1))
    assert (many.errors + many.biases) @ spectrum.power <= 1.12 * (few.errors + few.biases) @ spectrum.power + FLOOR


@pytest.mark.parametrize("n_taps", [1, 2, 3, 4])
def test_errors_fall_with_oversampling_by_6_db_for_each_tap(n_taps):
    """A polynomial of that order has this slope, and so has any equally good method."""
    assert np.diff(errors_db(fitted_error, n_taps)) == pytest.approx(-6.02 * n_taps, abs=0.6)


def test_errors_of_a_single_tap_are_images_of_a_sawtooth():
    """The phase error is proportional to the distance from the nearest sample, and a sawtooth has images of 1 / h²."""
    images = DelayFit(1, 1 / (16 * RATE_HZ), DEFAULT).images
    for number, share in images.items():
        assert share @ DEFAULT.power == pytest.approx(0.4 / number**2, abs=0.02)


@pytest.mark.parametrize("name", TEXTBOOK)
def test_errors_of_textbook_weights_fall_by_6_db_for_each_tap(name):
    assert np.diff(errors_db(textbook_error, name)) == pytest.approx(-6.02 * TEXTBOOK[name][0], abs=0.6)


def test_single_fitted_tap_is_a_rotated_carrier():
    rotated_db = errors_db(textbook_error, "nearest sample, carrier rotated")
    assert errors_db(fitted_error, 1) == pytest.approx(rotated_db, abs=0.1)
    assert (rotated_db < errors_db(textbook_error, "nearest sample") - 10).all()


def plain_errors(made, step_s, frequency_hz):
    """Variance and squared mean of the error at one frequency, over very many delays."""
    delays_s = (np.arange(4000) + 0.5) / 1000 * step_s
    first, fractions = made.split(delays_s)
    weights = made.weights(fractions)
    taken_s = (first[:, None] + np.arange(made.n_taps)) * step_s
    gain = made.gain(np.array([frequency_hz]))[0]
    wrong = gain * np.sum(weights * np.exp(2j * np.pi * frequency_hz * (taken_s - delays_s[:, None])), axis=1) - 1
    # Turned to the delayed sample's own phase, errors would be others than the fit's, which are to a kept sample's.
    wrong *= np.exp(2j * np.pi * frequency_hz * fractions * step_s)
    return np.var(wrong), np.abs(np.mean(wrong)) ** 2


@pytest.mark.parametrize("n_taps", range(1, 6))
@pytest.mark.parametrize("oversampling", [1, 3, 10])
def test_fit_errors_equal_a_direct_evaluation(n_taps, oversampling):
    step_s = 1 / (RATE_HZ * oversampling)
    made = DelayFit(n_taps, step_s, DEFAULT)
    assert fitted_error(DEFAULT, step_s, n_taps) == pytest.approx(
        (made.errors + made.biases) @ DEFAULT.power, rel=0.01, abs=FLOOR
    )
    for wave in range(0, 40, 6):
        varying, shared = plain_errors(made, step_s, DEFAULT.frequency_hz[wave])
        assert made.errors[wave] == pytest.approx(varying, rel=0.01, abs=FLOOR)
        assert made.biases[wave] == pytest.approx(shared, rel=0.01, abs=1e-3 * varying + FLOOR)


@settings(max_examples=20, deadline=None)
@given(call=calls, rate=rates, n_taps=st.integers(1, 6), seed=st.integers(0, 99))
def test_delayed_wave_is_within_the_predicted_error(call, rate, n_taps, seed):
    """The wave has all frequencies with random phases, and delays before and after the first kept sample."""
    spectrum, step_s, random = spectrum_of(call), step_s_of(call, rate), np.random.default_rng(seed)
    made = DelayFit(n_taps, step_s, spectrum)
    delays_s = random.uniform(-0.1, 0.1, 1500)  # so long that no two waves agree
    first, fractions = made.split(delays_s)
    lowest = (n_taps - 1) // 2 - 0.5 * (n_taps % 2)
    assert_allclose((first + fractions) * step_s, delays_s, atol=1e-14)
    assert ((fractions >= lowest - 1e-9) & (fractions <= lowest + 1 + 1e-9)).all()
    waves = np.sqrt(spectrum.power) * np.exp(2j * np.pi * random.random(len(spectrum.power)))

    def heard(gain, time_s):
        return np.exp(2j * np.pi * time_s[..., None] * spectrum.frequency_hz) @ (gain * waves)

    kept = heard(made.gain(spectrum.frequency_hz), (first[:, None] + np.arange(n_taps)) * step_s)
    wrong = np.sum(made.weights(fractions) * kept, axis=1) - heard(1.0, delays_s)
    predicted = float((made.errors + made.biases) @ spectrum.power)
    assert np.mean(np.abs(wrong) ** 2) < 1.3 * predicted + FLOOR


@pytest.mark.parametrize("name", list(TEXTBOOK)[1:])
def test_textbook_weights_are_exact_at_the_carrier(name):
    assert textbook_error(Spectrum(np.array([37e3]), np.ones(1)), 1 / RATE_HZ, name) < 1e-20


def test_weights_have_the_shape_of_the_fractions():
    made = DelayFit(3, 1 / RATE_HZ, DEFAULT)
    first, fractions = made.split(np.linspace(-1e-4, 1e-4, 20).reshape(4, 5))
    assert first.shape == fractions.shape == (4, 5)
    assert made.weights(fractions).shape == (4, 5, 3)


def test_fitted_weights_and_gain_are_a_minimum():
    """Any small change of the result of `fit` has a larger error."""
    random = np.random.default_rng(3)
    taps, targets = np.exp(1j * random.standard_normal((2, 12, 5)))[:, :, :3]
    power = random.random(12)
    gain, weights = fit(taps, targets, power)

    def error(gain, weights):
        return float(power @ np.sum(np.abs(targets - gain[:, None] * (taps @ weights)) ** 2, axis=1))

    smallest = error(gain, weights)
    assert smallest > 0.1
    for _ in range(50):
        step = 1e-3 * random.standard_normal((2, *weights.shape)) @ np.eye(3)
        assert error(gain, weights + step[0] + 1j * step[1]) > smallest
        assert error(gain * (1 + 1e-3 * np.exp(2j * np.pi * random.random(12))), weights) > smallest - 1e-3 * smallest


def test_real_fitted_weights_are_optimal():
    random = np.random.default_rng(4)
    taps, targets = np.exp(1j * random.standard_normal((2, 12, 4)))
    power = random.random(12)
    weights = weights_of(np.ones(12, complex), taps, targets, power, real=True)
    assert not weights.imag.any()
    root = np.sqrt(power)[:, None]
    stacked = [np.concatenate([(root * part).real, (root * part).imag]) for part in (taps, targets)]
    assert_allclose(weights.real, np.linalg.lstsq(*stacked, rcond=None)[0], atol=1e-9)
