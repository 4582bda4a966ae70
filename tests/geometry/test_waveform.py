"""The call, its matched filter and the decimation filter agree with their equations."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import assume, given, settings, strategies as st
from numpy.testing import assert_allclose

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry.waveform import (
    call_at,
    call_samples,
    decimation_taps,
    filter_response,
    integer_taps,
    matched_band_hz,
    matched_filter_spectrum,
    matched_guard_s,
)
from ertis_numba.settings import Call, Processing, Recording, Settings
from tests.pages import page

RATE_HZ = 450_000.0
PCM = Recording(sample_rate_hz=RATE_HZ, encoding="float32")
LOW = Call()
HIGH = Call(start_frequency_hz=80_000.0, stop_frequency_hz=20_000.0)
UP = Call(start_frequency_hz=25_000.0, stop_frequency_hz=50_000.0)
CALLS = pytest.mark.parametrize("call", [LOW, HIGH, UP], ids=["25_50", "20_80", "upward"])
calls = st.builds(
    lambda low_hz, high_hz, upward, **others: Call(
        start_frequency_hz=low_hz if upward else high_hz, stop_frequency_hz=high_hz if upward else low_hz, **others
    ),
    low_hz=st.floats(15_000, 45_000),
    high_hz=st.floats(55_000, 100_000),
    upward=st.booleans(),
    duration_s=st.floats(5e-4, 5e-3),
    ramp_fraction=st.floats(0, 0.5),
)


def settings_of(call, **others):
    """Settings of a record that is not decimated."""
    return Settings(call=call, recording=PCM, processing=Processing(range_decimation=10, decimation=1, **others))


def compressed(signal, call, n_fft):
    """Return the analytic signal after the matched filter: (sample,) complex."""
    matched = matched_filter_spectrum(settings_of(call), n_fft=n_fft)
    bins = slice(matched.first_bin, matched.first_bin + len(matched.values))
    spectrum = np.zeros(n_fft, dtype=complex)
    spectrum[bins] = np.fft.rfft(signal, n_fft)[bins] * matched.values
    return np.fft.ifft(spectrum)


# ---- the call --------------------------------------------------------------------------------------


def test_default_call_has_the_length_of_the_device():
    assert len(call_samples(LOW)) == 1126  # 0 to 2.5 ms inclusive at 450 kHz


@CALLS
def test_instantaneous_frequency_is_hyperbolic(call):
    rate_hz = 40e6
    samples = call_samples(call.replace(ramp_fraction=0.0), rate_hz=rate_hz)
    up = np.flatnonzero((samples[:-1] < 0) & (samples[1:] >= 0))
    crossing_s = (up + samples[up] / (samples[up] - samples[up + 1])) / rate_hz  # once a period
    middle_s = (crossing_s[1:] + crossing_s[:-1]) / 2
    period_s = 1 / call.start_frequency_hz + middle_s * (
        (1 / call.stop_frequency_hz - 1 / call.start_frequency_hz) / call.duration_s
    )
    # Crossings lie evenly in the logarithm of the period, so a cycle's mean period is off by their square.
    assert_allclose(np.diff(crossing_s), period_s, rtol=1e-3)
    assert_allclose(1 / period_s[[0, -1]], [call.start_frequency_hz, call.stop_frequency_hz], rtol=0.03)


@CALLS
def test_phase_matches_its_closed_form(call):
    time_s = np.linspace(0, call.duration_s, 999)
    f0, f1, duration_s = call.start_frequency_hz, call.stop_frequency_hz, call.duration_s
    slope = (1 / f1 - 1 / f0) / duration_s
    phase_rad = 2 * np.pi / slope * (np.log(1 / f0 + time_s * slope) - np.log(1 / f0))
    assert_allclose(call_at(call.replace(ramp_fraction=0.0), time_s), np.sin(phase_rad), atol=1e-9)


@CALLS
def test_ramps_are_halves_of_a_hann_window(call):
    ramp_s = 0.1 * call.duration_s
    time_s = np.linspace(0, ramp_s, 50)
    window = 0.5 - 0.5 * np.cos(np.pi * time_s / ramp_s)
    plain = call.replace(ramp_fraction=0.0)
    assert_allclose(call_at(call, time_s), window * call_at(plain, time_s), atol=1e-12)
    late_s = call.duration_s - time_s
    assert_allclose(call_at(call, late_s), window * call_at(plain, late_s), atol=1e-12)
    between_s = np.linspace(ramp_s, call.duration_s - ramp_s, 2000)
    assert_allclose(call_at(call, between_s), call_at(plain, between_s), atol=1e-12)


@given(calls, st.lists(st.floats(-1, 1), min_size=1, max_size=20))
def test_call_is_bounded_and_silent_outside(call, time_s):
    time_s = np.array(time_s)
    values = call_at(call, time_s)
    assert np.all(np.abs(values) <= 1)
    assert not values[(time_s < 0) | (time_s > call.duration_s)].any()


# ---- the matched filter ----------------------------------------------------------------------------


@CALLS
def test_matched_filter_turns_the_call_into_one_peak(call):
    image = compressed(call_samples(call, rate_hz=RATE_HZ), call, 4096)
    assert image[0] == pytest.approx(1, abs=1e-12)  # real, 1, at lag 0
    assert np.abs(image).argmax() == 0
    bandwidth_hz = call.high_frequency_hz - call.low_frequency_hz
    width = 2 * np.abs(compressed(call_samples(call, rate_hz=RATE_HZ), call, 2**20)[:2000] > 2**-0.5).sum() / RATE_HZ
    assert width * bandwidth_hz < 2


@settings(max_examples=60, deadline=None)
@given(calls, st.integers(2500, 9000))
def test_matched_filter_peaks_for_any_call(call, n_fft):
    low_hz, high_hz = matched_band_hz(settings_of(call))
    matched = matched_filter_spectrum(settings_of(call), n_fft=n_fft)
    frequency_hz = (matched.first_bin + np.arange(len(matched.values))) * RATE_HZ / n_fft
    assert 0 < low_hz <= frequency_hz[0]
    assert frequency_hz[-1] <= high_hz < RATE_HZ / 2
    assert call.low_frequency_hz - 1500 < matched.centre_hz < call.high_frequency_hz + 1500
    image = compressed(call_samples(call, rate_hz=RATE_HZ), call, n_fft)
    assert image[0] == pytest.approx(1, abs=1e-9)
    assert np.abs(image).max() == pytest.approx(1, abs=1e-9)


@CALLS
def test_matched_filter_ends_within_its_guard(call):
    """The impulse response lasts the call's length backwards plus a guard on either side, down to −50 dB."""
    n_fft, at = 16_384, 8192
    impulse = np.zeros(n_fft)
    impulse[at] = 1.0
    ringing = np.abs(compressed(impulse, call, n_fft))
    guard = int(matched_guard_s(settings_of(call)) * RATE_HZ)
    length = int(call.duration_s * RATE_HZ)
    outside = np.r_[ringing[: at - length - guard], ringing[at + guard + 1 :]]
    assert 20 * np.log10(outside.max() / ringing.max()) < -50


def test_matched_filter_scales_with_the_echo_only():
    samples = call_samples(LOW, rate_hz=RATE_HZ)
    late = np.zeros(8192)
    late[3000 : 3000 + len(samples)] = -0.25 * samples
    image = compressed(late, LOW, 8192)
    assert np.abs(image).argmax() == 3000
    assert image[3000] == pytest.approx(-0.25, abs=1e-12)


@pytest.mark.parametrize("call", [LOW, Call(duration_s=2e-4, ramp_fraction=0.0)], ids=["default", "short, no ramp"])
def test_matched_filter_of_decimated_signals_has_the_bins_of_the_record(call):
    """At the decimated rate a call that is short or has no ramp would alias."""
    made = Settings(call=call)
    assert made.decimation == 20
    decimated = matched_filter_spectrum(made, n_fft=2_000)
    whole = matched_filter_spectrum(made, n_fft=40_000, decimation=1)
    assert decimated.first_bin == whole.first_bin
    assert_allclose(decimated.values, whole.values, rtol=1e-12, atol=1e-12 * np.abs(whole.values).max())


@pytest.mark.parametrize(
    ("row", "duration_s", "ramp_fraction"),
    [
        ("2.5 ms, ramps of 10 %, the default", 2.5e-3, 0.1),
        ("1 ms, ramps of 10 %", 1e-3, 0.1),
        ("0.2 ms, ramps of 10 %", 2e-4, 0.1),
        ("2.5 ms, no ramps", 2.5e-3, 0.0),
        ("0.2 ms, no ramps", 2e-4, 0.0),
    ],
)
def test_band_edges_change_an_echo_as_documented(row, duration_s, ramp_fraction):
    call = Call(duration_s=duration_s, ramp_fraction=ramp_fraction)
    found_db = [band_edge_error_db(call, edges_hz) for edges_hz in (None, (10e3, 65e3), (5e3, 90e3))]
    assert " | ".join((f"| {row}", *(f"−{-each:.0f} dB" for each in found_db), "")).strip() in page("accuracy")


@pytest.mark.parametrize(
    ("call", "band_edges_hz", "difference_db"),
    [
        (LOW, None, -58.0),
        (LOW, (5e3, 90e3), -81.2),
        (Call(duration_s=2e-4), None, -24.1),
        (Call(duration_s=2e-4), (5e3, 90e3), -37.6),
    ],
    ids=["default", "default, wide band", "0.2 ms", "0.2 ms, wide band"],
)
def test_errors_of_band_edges_stay_the_same(call, band_edges_hz, difference_db):
    assert band_edge_error_db(call, band_edges_hz) == pytest.approx(difference_db, abs=0.2)


def band_edge_error_db(call, band_edges_hz):
    """The comparison is with the textbook matched filter, which has no band limits."""
    n_fft = 2**17
    spectrum = np.fft.rfft(call_samples(call, rate_hz=4.5e6), n_fft)
    textbook = np.fft.ifft(np.append(np.abs(spectrum) ** 2, np.zeros(n_fft - len(spectrum))))
    textbook = np.abs(textbook) / np.abs(textbook[0])
    made = Settings(call=call, processing=Processing(band_edges_hz=band_edges_hz))
    matched = matched_filter_spectrum(made, n_fft=n_fft, decimation=1)
    bins = slice(matched.first_bin, matched.first_bin + len(matched.values))
    filtered = np.zeros(n_fft, dtype=complex)
    filtered[bins] = spectrum[bins] * matched.values
    difference = np.linalg.norm(np.abs(np.fft.ifft(filtered)) - textbook) / np.linalg.norm(textbook)
    return 20 * np.log10(difference)


# ---- the decimation filter -------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(decimation=st.integers(1, 40), share=st.floats(0.05, 0.97), sample_rate_hz=st.floats(1e5, 1e7))
def test_decimation_filter_meets_its_specification(decimation, share, sample_rate_hz):
    rate_hz = sample_rate_hz / decimation
    pass_hz = share * rate_hz / 2
    taps = decimation_taps(sample_rate_hz=sample_rate_hz, decimation=decimation, pass_hz=pass_hz)
    assume(len(taps) < 6000)
    assert taps.sum() == pytest.approx(1)
    assert_allclose(taps, taps[::-1], atol=1e-15)
    assert (len(taps) - 1) % (2 * decimation) == 0  # the group delay is whole in samples of either rate
    passed = filter_response(taps, np.linspace(0, pass_hz, 200) / sample_rate_hz)
    assert_allclose(passed, 1, atol=2e-3)
    for image in range(1, decimation // 2 + 1):  # whatever folds onto 0 … pass_hz
        folding_hz = np.linspace(image * rate_hz - pass_hz, min(image * rate_hz + pass_hz, sample_rate_hz / 2), 100)
        gain_db = 20 * np.log10(np.abs(filter_response(taps, folding_hz / sample_rate_hz)).max() + 1e-12)
        assert gain_db < -59.4


def test_default_decimation_filter_has_61_taps_and_60_db():
    made = Settings()
    taps = decimation_taps(
        sample_rate_hz=made.recording.sample_rate_hz, decimation=10, pass_hz=matched_band_hz(made)[1]
    )
    assert len(taps) == 61
    folding = filter_response(taps, np.linspace(395e3, 505e3, 500) / 4.5e6)
    assert 20 * np.log10(np.abs(folding).max()) < -60


def test_filter_response_matches_the_taps():
    taps = decimation_taps(sample_rate_hz=4.5e6, decimation=10, pass_hz=85e3)
    frequency = np.linspace(0, 0.5, 64)
    half = (len(taps) - 1) / 2
    spectrum = np.exp(-2j * np.pi * np.outer(frequency, np.arange(len(taps)))) @ taps
    assert_allclose(filter_response(taps, frequency), (spectrum * np.exp(2j * np.pi * frequency * half)).real)


@pytest.mark.parametrize("decimation", [10, 30])
def test_decimation_below_the_signal_bandwidth_is_refused(decimation):
    rate_hz = 4.5e6 / decimation
    with pytest.raises(
        ArgumentError,
        match=f"decimation {decimation} gives a rate of {rate_hz:g} Hz, too low .*Hz; use a smaller decimation",
    ):
        decimation_taps(sample_rate_hz=4.5e6, decimation=decimation, pass_hz=0.499 * rate_hz)


@settings(max_examples=60, deadline=None)
@given(decimation=st.integers(1, 100), share=st.floats(0.05, 0.5))
def test_integer_taps_change_the_filter_little_or_are_refused(decimation, share):
    taps = decimation_taps(sample_rate_hz=4.5e6, decimation=decimation, pass_hz=share * 4.5e6 / decimation / 2)
    whole = integer_taps(taps)
    assert whole.dtype == np.int16
    assert np.abs(whole.astype(int)).sum() <= 32_767
    change = np.fft.rfft(whole / whole.sum(dtype=int) - taps, 8 * len(taps))
    assert 20 * np.log10(np.abs(change).max() + 1e-12) < -49


def test_tap_sums_beyond_16_bits_are_refused():
    taps = decimation_taps(sample_rate_hz=4.5e6, decimation=500, pass_hz=0.8 * 4500)
    with pytest.raises(ArgumentError, match=r"decimation filter of \d+ taps is too long for 16 bits .* smaller"):
        integer_taps(taps)
    with pytest.raises(ArgumentError, match="too long for 16 bits"):
        integer_taps(np.full(70_001, 1 / 70_001))


@pytest.mark.parametrize("modulation", ["hyperbolic", "linear"])
@pytest.mark.parametrize(("start_hz", "stop_hz"), [(50e3, 25e3), (20e3, 80e3)])
def test_instantaneous_frequency_follows_the_modulation(modulation, start_hz, stop_hz):
    """Phase differences of the samples, except near the ends, are compared with the definition."""
    call = Call(start_frequency_hz=start_hz, stop_frequency_hz=stop_hz, modulation=modulation, ramp_fraction=0.0)
    rate_hz = 10e6
    analytic = scipy.signal.hilbert(call_samples(call, rate_hz=rate_hz))
    found_hz = np.diff(np.unwrap(np.angle(analytic))) * rate_hz / 2 / np.pi
    share = (np.arange(len(found_hz)) + 0.5) / len(found_hz)
    wanted_hz = (
        start_hz + share * (stop_hz - start_hz)
        if modulation == "linear"
        else 1 / (1 / start_hz + share * (1 / stop_hz - 1 / start_hz))
    )
    middle = slice(len(share) // 8, -len(share) // 8)
    assert np.median(np.abs(found_hz[middle] / wanted_hz[middle] - 1)) < 0.005
    assert np.abs(np.mean(found_hz[middle] - wanted_hz[middle])) < 100


@pytest.mark.parametrize(
    "call", [LOW, Call(waveform=tuple(np.hanning(64) * np.sin(np.arange(64))))], ids=["sweep", "own"]
)
def test_delay_is_silence_before_the_call(call):
    late = call.replace(delay_s=1.0005e-3)
    assert (late.n_silent, late.start_s, late.end_s) == (450, 1e-3, 1e-3 + call.duration_s)
    samples = call_samples(late)
    assert not samples[:450].any()
    assert_allclose(samples[450:], call_samples(call), atol=1e-12)
    time_s = np.arange(3000) / 1e6
    assert_allclose(call_at(late, time_s + 1e-3), call_at(call, time_s), atol=1e-9)
    assert late.sounds_like(call)
    assert not late.sounds_like(HIGH)


def test_delay_does_not_change_ranges():
    """An echo of a delayed call is found at the time after its emission."""
    settings = settings_of(LOW.replace(delay_s=2e-3))
    n_fft = 8192
    signal = np.zeros(n_fft)
    echo = call_samples(settings.call)
    signal[1000 : 1000 + len(echo)] = echo
    spectrum = matched_filter_spectrum(settings, n_fft=n_fft)
    bins = slice(spectrum.first_bin, spectrum.first_bin + len(spectrum.values))
    compressed_spectrum = np.zeros(n_fft, complex)
    compressed_spectrum[bins] = np.fft.rfft(signal)[bins] * spectrum.values
    envelope = np.abs(np.fft.ifft(compressed_spectrum))
    assert (envelope.argmax(), round(envelope.max(), 6)) == (1000, 1.0)


@pytest.mark.parametrize(
    ("delay_s", "message"),
    [
        (-1e-3, r"call\.delay_s is -0\.001; use a number from 0 to 1"),
        (1.5, r"call\.delay_s is 1\.5; use a number from 0 to 1"),
        (float("nan"), r"call\.delay_s is nan"),
    ],
)
def test_impossible_delay_is_refused(delay_s, message):
    with pytest.raises(ArgumentError, match=message):
        Call(delay_s=delay_s)


def test_delay_counts_among_the_samples_of_a_call():
    with pytest.raises(ArgumentError, match=r"call has 1600000 samples .* Shorten call\.duration_s or call\.delay_s"):
        Call(delay_s=0.6, duration_s=0.2, sample_rate_hz=2e6)
