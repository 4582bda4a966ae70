"""Array-level functions give the signals and images of a pipeline and of the float64 reference."""

import math

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba import kernels
from ertis_numba.geometry import array_weights, direction_grid, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_samples, matched_band_hz
from ertis_numba.settings import Accuracy, Call, Processing
from tests.cases import CASES, SHORT, noise
from tests.reference import error_db, exact

SIMULATED = {name for name in kernels.usable() if kernels.load(name).simulated}
DEVICES = [name for name in kernels.usable() if name not in SIMULATED]
SPHERICAL = SHORT.replace(processing=Processing(directions="3d:11", range_m=(0.2, 0.5), wavefront="spherical"))


def demodulated(settings, data, device="cpu"):
    return ertis.demodulate(
        data,
        sample_rate_hz=settings.recording.sample_rate_hz,
        decimation=settings.decimation,
        passband_hz=matched_band_hz(settings)[1],
        channels=np.flatnonzero(microphones(settings.array).enabled),
        stopband_attenuation_db=settings.accuracy.stopband_attenuation_db or 60.0,
        device=device,
    )


def matched(settings, signals, device="cpu"):
    return ertis.matched_filter(
        signals, sample_rate_hz=settings.signal_rate_hz, call=settings.call, decimation=settings.decimation,
        device=device,
    )  # fmt: skip


def image_of(settings, data, ranges_m, device="cpu"):
    layout, grid = microphones(settings.array), direction_grid(settings.processing)
    signals = matched(settings, demodulated(settings, data, device), device)
    return ertis.beamform(
        signals / layout.gain[layout.enabled, None],
        layout.enabled_positions_m,
        np.stack([grid.azimuth_rad, grid.elevation_rad], axis=1),
        sample_rate_hz=settings.signal_rate_hz,
        ranges_m=ranges_m,
        sound_speed_m_s=sound_speed_m_s(settings.air),
        band_hz=matched_band_hz(settings),
        weights=array_weights(settings),
        delay_s=layout.delay_s[layout.enabled],
        wavefront=settings.processing.wavefront,
        device=device,
    )


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ["default", "64 bits, two words", "16 bits, disabled", "PCM of 16 bits"])
def test_demodulate_and_matched_filter_give_the_signals_of_a_pipeline(name, device):
    measurement = noise(CASES[name])
    with ertis.Pipeline(CASES[name], "cpu", 1, predict=False) as pipeline:
        expected, settings = pipeline.signals(measurement), pipeline.settings
    signals = demodulated(settings, measurement.data, device)
    if settings.recording.is_pdm:
        assert np.array_equal(signals, expected.demodulated)
    assert np.abs(signals - expected.demodulated).max() < 1e-6
    assert error_db(matched(settings, signals, device), expected.matched) < -60


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "settings",
    [CASES["default"], CASES["calibrated"], CASES["array weights"], CASES["PCM, calibrated"], SPHERICAL],
    ids=["default", "calibrated", "array weights", "PCM", "spherical"],
)
def test_beamform_gives_the_exact_image(settings, device):
    measurement, grid = noise(settings), direction_grid(settings.processing)
    first_m, last_m = settings.processing.range_m
    ranges_m = np.linspace(first_m, last_m, 57)
    expected = exact(
        measurement.data,
        settings,
        unit_vectors(grid.azimuth_rad, grid.elevation_rad),
        ranges_m,
        spherical=settings.processing.wavefront == "spherical",
    )
    assert error_db(image_of(settings, measurement.data, ranges_m, device), expected) < -50


def test_beamform_gives_the_image_of_a_pipeline():
    settings = SHORT.replace(accuracy=Accuracy(max_error_db=-60.0))
    measurement = noise(settings)
    with ertis.Pipeline(settings, "cpu", predict=False) as pipeline:
        image = pipeline.process(measurement)
    assert error_db(image_of(pipeline.settings, measurement.data, image.range_m), image.amplitude) < -55


def test_beamform_interpolates_requested_ranges():
    measurement, ranges_m = noise(SHORT), np.arange(0.5, 0.8, 0.001)
    image = image_of(SHORT, measurement.data, ranges_m)
    for every in (slice(None, None, 7), slice(30, 31), slice(10, 60)):
        assert error_db(image_of(SHORT, measurement.data, ranges_m[every]), image[:, every]) < -60


def test_beamform_makes_real_signals_analytic():
    signals = demodulated(SHORT, noise(SHORT).data)
    spectra = np.fft.fft(signals.astype(float), 2 * signals.shape[1], axis=1)
    spectra[:, signals.shape[1] + 1 :] = 0
    spectra[:, 1 : signals.shape[1]] *= 2
    analytic = np.fft.ifft(spectra, axis=1)[:, : signals.shape[1]]
    given = {
        "positions_m": microphones(SHORT.array).enabled_positions_m,
        "directions_rad": [[0.1, 0.0], [-0.4, 0.2]],
        "sample_rate_hz": SHORT.signal_rate_hz,
        "ranges_m": np.linspace(0.4, 0.9, 99),
        "band_hz": (20e3, 60e3),
    }
    assert error_db(ertis.beamform(signals, **given), ertis.beamform(analytic, **given)) < -60


def test_bits_are_demodulated_like_the_words_that_contain_them():
    bits = np.random.default_rng(3).integers(0, 2, (9_000, 11)).astype(bool)
    words = (bits @ (1 << np.arange(11))).astype(np.uint16)
    given = {"sample_rate_hz": 4.5e6, "decimation": 10}
    signals = ertis.demodulate(bits, **given)
    assert np.array_equal(signals, ertis.demodulate(words, **given)[:11])
    assert np.array_equal(signals[[4, 2]], ertis.demodulate(words.astype(">u2"), channels=[4, 2], **given))
    assert signals.shape == (11, 900)


def test_decimation_attenuates_aliasing_frequencies():
    time_s = np.arange(450_000) / 4.5e6
    for frequency_hz, gain in ((151e3, 1.0), (291e3, 1e-3)):
        tone = np.sin(2 * math.pi * frequency_hz * time_s)
        signals = ertis.demodulate(tone, sample_rate_hz=4.5e6, decimation=10)
        assert math.sqrt(2) * signals[0, 500:-500].std() == pytest.approx(gain, abs=1.1e-3)


def test_waveform_is_matched_like_the_call_that_it_samples():
    call = Call()
    signals = np.random.default_rng(1).standard_normal((2, 3, 5_000))
    given = {"sample_rate_hz": 450e3, "band_edges_hz": (19e3, 56e3)}
    sampled = ertis.matched_filter(signals, call=call_samples(call), **given)
    assert error_db(sampled, ertis.matched_filter(signals, call=call, **given)) < -30
    assert ertis.matched_filter(signals, call=call, **given).shape == (2, 3, 5_000)


WORDS = np.zeros(4_500, np.uint8)
SIGNALS = np.ones((2, 900))
BEAMFORM = {
    "signals": SIGNALS,
    "positions_m": np.zeros((2, 3)),
    "directions_rad": np.zeros((1, 2)),
    "sample_rate_hz": 450e3,
    "ranges_m": np.linspace(0.1, 0.2, 9),
}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ertis.demodulate(WORDS, sample_rate_hz=0, decimation=10), "sample_rate_hz is 0"),
        (lambda: ertis.demodulate(WORDS, sample_rate_hz=4.5e6, decimation=0), "decimation is 0; use a whole number"),
        (lambda: ertis.demodulate(WORDS[:0], sample_rate_hz=4.5e6, decimation=9), "data holds uint8 of shape"),
        (lambda: ertis.demodulate(WORDS.astype("i4"), sample_rate_hz=4.5e6, decimation=9), "data holds int32"),
        (lambda: ertis.demodulate([math.nan], sample_rate_hz=4.5e6, decimation=9), "data holds nan at"),
        (
            lambda: ertis.demodulate(WORDS, sample_rate_hz=4.5e6, decimation=9, channels=[8]),
            r"channels\[0\] is 8; use a whole number from 0 to 7",
        ),
        (lambda: ertis.demodulate(WORDS, sample_rate_hz=4.5e6, decimation=9, channels=[]), "channels is empty"),
        (
            lambda: ertis.demodulate(np.zeros((9, 200), np.uint64), sample_rate_hz=4.5e6, decimation=9),
            "data has 12800 channels; the limit is 1024",
        ),
        (
            lambda: ertis.demodulate(WORDS, sample_rate_hz=4.5e6, decimation=100, passband_hz=5e4),
            "decimation 100 gives a rate of 45000 Hz, too low for signals up to 50000 Hz",
        ),
        (
            lambda: ertis.demodulate(WORDS, sample_rate_hz=4.5e6, decimation=9, passband_hz=-1.0),
            "passband_hz is -1",
        ),
        (lambda: ertis.demodulate(WORDS, sample_rate_hz=4.5e6, decimation=9, device="tpu"), "device 'tpu' is unknown"),
        (lambda: ertis.matched_filter(SIGNALS, sample_rate_hz=9e4, call=Call()), "sample_rate_hz is 90000; use more"),
        (lambda: ertis.matched_filter(SIGNALS * 1j, sample_rate_hz=450e3, call=Call()), "signals holds complex128"),
        (lambda: ertis.matched_filter(SIGNALS, sample_rate_hz=450e3, call=[1, 2]), "call has 2 samples; use 17 to"),
        (lambda: ertis.matched_filter(SIGNALS, sample_rate_hz=450e3, call="sweep"), "call holds <U5 of shape"),
        (
            lambda: ertis.matched_filter(SIGNALS, sample_rate_hz=450e3, call=Call(), band_edges_hz=(3e4, 6e4)),
            "band_edges_hz is 30000 to 60000 Hz, but the call sweeps over 25000 to 50000 Hz",
        ),
        (
            lambda: ertis.matched_filter((SIGNALS * 32767).astype("i2"), sample_rate_hz=450e3, call=Call()),
            "signals holds int16, whose full scale is unknown; divide by it, as in samples / 32768",
        ),
        (lambda: ertis.beamform(**BEAMFORM | {"signals": SIGNALS.astype("i2")}), "signals holds int16, whose full"),
        (
            lambda: ertis.beamform(**BEAMFORM | {"sample_rate_hz": 450.0}),
            "sample_rate_hz is 450; use a number from 1000",
        ),
        (
            lambda: ertis.beamform(**BEAMFORM | {"sample_rate_hz": 2e4, "band_hz": (5e3, 2e4)}),
            "band_hz ends at 20000 Hz, above half of sample_rate_hz, 10000 Hz",
        ),
        (
            lambda: ertis.beamform(**BEAMFORM | {"positions_m": [[0, 0, 0], [0, 50.0, 0]]}),
            "positions_m spans 50 m, more than 25 m; if the numbers are millimetres, divide them by 1000",
        ),
        (
            lambda: ertis.beamform(**BEAMFORM | {"positions_m": [[0, 0, 0], [0, 5.0, 0]]}),
            "positions_m lie up to 5 m from the origin, beyond the last of ranges_m, .* if the unit is not the metre",
        ),
        (lambda: ertis.beamform(**BEAMFORM | {"signals": SIGNALS[0]}), "signals holds float64 of shape"),
        (lambda: ertis.beamform(**BEAMFORM | {"positions_m": np.zeros((3, 3))}), r"positions_m has shape \(3, 3\)"),
        (lambda: ertis.beamform(**BEAMFORM | {"positions_m": "here"}), "positions_m holds no array of numbers"),
        (lambda: ertis.beamform(**BEAMFORM | {"directions_rad": [[0.0, 45.0]]}), r"directions_rad\[0, 1\] is 45; use"),
        (lambda: ertis.beamform(**BEAMFORM | {"directions_rad": [0.0, 1.0]}), "directions_rad holds float64 of shape"),
        (lambda: ertis.beamform(**BEAMFORM | {"ranges_m": [0.1, 0.2, 0.4]}), "ranges_m has steps from 0.1 to 0.2 m"),
        (lambda: ertis.beamform(**BEAMFORM | {"ranges_m": [0.2, 0.1]}), "ranges_m has steps from -0.1 to -0.1 m"),
        (lambda: ertis.beamform(**BEAMFORM | {"ranges_m": [-0.1, 0.1]}), "ranges_m begins at -0.1 m"),
        (lambda: ertis.beamform(**BEAMFORM | {"ranges_m": 0.3}), "ranges_m holds float64 of shape"),
        (lambda: ertis.beamform(**BEAMFORM | {"ranges_m": [0.1, 0.5]}), "ranges_m ends at 0.5 m, but signals of 2 ms"),
        (lambda: ertis.beamform(**BEAMFORM | {"weights": [-1.0, 2.0]}), "weights holds -1 and adds up to 1"),
        (lambda: ertis.beamform(**BEAMFORM | {"weights": [1.0]}), r"weights has shape \(1,\); pass shape \(2,\)"),
        (lambda: ertis.beamform(**BEAMFORM | {"wavefront": "auto"}), "wavefront 'auto' is unknown"),
        (lambda: ertis.beamform(**BEAMFORM | {"sound_speed_m_s": -1}), "sound_speed_m_s is -1"),
        (lambda: ertis.beamform(**BEAMFORM | {"threads": 0}), "threads is 0"),
        (
            lambda: ertis.beamform(**BEAMFORM | {"ranges_m": np.arange(0, 0.3, 0.1), "band_hz": (1e4, 2e5)}),
            "ranges_m has a step of 0.5.* ms in echo time",
        ),
    ],
)
def test_unusable_arguments_are_refused_in_one_line(call, message):
    with pytest.raises(ertis.ArgumentError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
