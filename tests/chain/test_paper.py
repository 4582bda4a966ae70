"""The paper's method equals its float64 forms on every device, and finds an analytic echo."""

import math

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.paper import PaperChain
from ertis_numba.chain.plan_elements import chain_taps
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import array_weights, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at, filter_response, matched_filter_spectrum
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Call, Processing, Recording, Settings
from tests import reference
from tests.cases import CASES, SHORT, noise, words_of

FLOAT32_DB = -100  # 111 dB below the float64 image on a real measurement


def with_paper(settings: Settings, **changes) -> Settings:
    return settings.replace(processing=settings.processing.replace(method="paper", **changes))


@pytest.mark.parametrize("name", CASES)
def test_recursive_filters_of_the_paper_equal_their_float64_reference(name):
    settings = with_paper(CASES[name])
    pipeline = Pipeline(settings, "numpy", predict=False)
    measurement = noise(settings)
    image = pipeline.process(measurement)
    directions = unit_vectors(pipeline.grid.azimuth_rad, pipeline.grid.elevation_rad)
    expected, range_m = reference.paper(measurement.data, settings, directions)
    assert image.range_m == pytest.approx(range_m, rel=1e-12)
    assert reference.error_db(image.amplitude, expected) < FLOAT32_DB


def in_float64(words, settings):
    """The image of the paper's method with filters of linear phase, at the full rate: (direction, range) float64."""
    layout, step, rate_hz = microphones(settings.array), settings.decimation, settings.signal_rate_hz
    taps = chain_taps(settings)
    taps, half = taps / taps.sum(dtype=np.int64), len(taps) // 2
    signals = reference.signals_of(words, np.flatnonzero(layout.enabled), settings.recording)
    slow = np.array([np.convolve(signal, taps)[half : half + len(signal) : step] for signal in signals])
    n_fft = 4 * slow.shape[1]
    matched = matched_filter_spectrum(settings, n_fft=n_fft)
    bins = matched.first_bin + np.arange(len(matched.values))
    spectra = np.zeros((len(slow), n_fft), dtype=complex)
    flat = matched.values / filter_response(taps, bins / n_fft / step)
    spectra[:, bins] = np.fft.fft(slow, n_fft)[:, bins] * flat
    analytic = np.fft.ifft(spectra) * (array_weights(settings) / layout.gain[layout.enabled])[:, None]
    pipeline = Pipeline(settings, "numpy", predict=False)
    sample = np.rint(pipeline.range_m * 2 / sound_speed_m_s(settings.air) * rate_hz).astype(int)
    images = []
    for direction in unit_vectors(pipeline.grid.azimuth_rad, pipeline.grid.elevation_rad):
        delay_s = layout.delay_s[layout.enabled] - layout.enabled_positions_m @ direction / sound_speed_m_s(
            settings.air
        )
        rows = zip(analytic, np.rint(delay_s * rate_hz).astype(int), strict=True)
        images.append(np.abs(np.mean([row[(sample + delay) % n_fft] for row, delay in rows], axis=0)))
    return np.array(images)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("device", ["numpy", "cpu"])
def test_paper_image_of_kernels_equals_its_float64_reference(name, device):
    settings, words = with_paper(CASES[name]), noise(CASES[name]).data
    kernel_set = kernels.load(device)
    chain = PaperChain(settings, kernel_set, threads=kernel_set.max_threads)
    image = chain.new_image()
    chain.process(sample_format(settings).validated(words), image)
    assert reference.error_db(image, in_float64(words, settings)) < FLOAT32_DB


@pytest.fixture(params=["numpy", "cpu"])
def device(request):
    """Recursive filters in SciPy, and kernels."""
    return request.param


def echo(settings: Settings, *, azimuth_deg: float, range_m: float, level: float):
    """One plane echo of the call, in words for the array of the settings."""
    speed_m_s = sound_speed_m_s(settings.air)
    direction = unit_vectors(np.radians(azimuth_deg), np.float64(0))
    delay_s = -(microphones(settings.array).enabled_positions_m @ direction) / speed_m_s
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    arrival_s = 2 * range_m / speed_m_s + delay_s[:, None]
    return words_of(level * call_at(settings.call, time_s - arrival_s))


@pytest.mark.parametrize("call", [Call(), Call(start_frequency_hz=80e3, stop_frequency_hz=20e3)])
def test_paper_echo_has_its_range_and_amplitude(call, device):
    """The group delays of all filters are removed, including those of recursive ones."""
    settings = with_paper(SHORT.replace(call=call), directions="2d:181", range_decimation=10, range_m=(0.65, 0.75))
    words = echo(settings, azimuth_deg=20.0, range_m=0.7, level=0.8)
    image = Pipeline(settings, device, predict=False).process(Measurement(words, settings))
    direction, distance = np.unravel_index(np.argmax(image.amplitude), image.amplitude.shape)
    assert math.degrees(image.azimuth_rad[direction]) == pytest.approx(20.0, abs=1.0)
    # Two samples of 0.38 mm: the recursive low pass delays a pulse a little more than its lowest frequency.
    assert image.range_m[distance] == pytest.approx(0.7, abs=8e-4)
    assert image.amplitude.max() == pytest.approx(0.8, rel=0.03)


def test_paper_and_exact_image_agree_on_the_echo(device):
    settings = with_paper(SHORT, directions="2d:61")
    words = echo(settings, azimuth_deg=-33.0, range_m=0.6, level=0.5)
    image = Pipeline(settings, device, predict=False).process(Measurement(words, settings))
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    exact = reference.exact(words, settings, directions, image.range_m)
    assert np.argmax(image.amplitude) == np.argmax(exact)
    assert image.amplitude.max() == pytest.approx(exact.max(), rel=0.12)  # both sample the range axis at 45 kHz


def test_range_axis_equals_that_of_the_paper(device):
    settings = with_paper(Settings())
    step_m = sound_speed_m_s(settings.air) / (2 * 45_000)
    indices = Pipeline(settings, device, predict=False).range_m / step_m
    assert indices == pytest.approx(np.arange(131, 1309), abs=1e-9)  # 0.5 and 5 m in steps of 3.82 mm


def test_envelope_has_no_carrier_ripple(device):
    """Without decimation, the envelope of a call has no ripple at twice the carrier."""
    settings = with_paper(SHORT, directions="2d:1", range_decimation=10, range_m=(0.65, 0.75))
    words = echo(settings, azimuth_deg=0.0, range_m=0.7, level=1.0)
    row = Pipeline(settings, device, predict=False).process(Measurement(words, settings)).amplitude[0]
    spectrum = np.abs(np.fft.rfft(row * np.hanning(len(row))))
    frequency_hz = np.fft.rfftfreq(len(row), 1 / 450e3)
    assert spectrum[frequency_hz > 45e3].max() < 2e-3 * spectrum.max()


@pytest.mark.parametrize(
    ("processing", "n_samples", "match"),
    [
        (Processing(range_m=(0.5, 5.0)), 40_960, "range_m ends at 5 m, but the record of 9.102 ms covers 1.563 m"),
        (Processing(range_m=(0.701, 0.702)), 40_960, "0.701 to 0.702 m, contains no multiple of .*0.003821 m; extend"),
        (Processing(range_m=(0.0, 0.1)), 9, "range_m ends at 0.1 m, but the record of 0.002 ms covers 0 m"),
    ],
)
def test_paper_method_refuses_invalid_ranges(processing, n_samples, match, device):
    settings = Settings(recording=Recording(n_samples=n_samples), processing=processing.replace(method="paper"))
    with pytest.raises(ArgumentError, match=match):
        Pipeline(settings, device)


def test_both_forms_of_the_paper_agree_on_an_echo():
    """Filters of linear phase and the authors' recursive ones give the same reflector, not the same side lobes."""
    settings = with_paper(SHORT, directions="2d:61")
    measurement = Measurement(echo(settings, azimuth_deg=-33.0, range_m=0.6, level=0.5), settings)
    recursive, linear = (Pipeline(settings, device, predict=False).process(measurement) for device in ("numpy", "cpu"))
    assert np.array_equal(recursive.range_m, linear.range_m)
    assert np.argmax(recursive.amplitude) == np.argmax(linear.amplitude)
    assert linear.amplitude.max() == pytest.approx(recursive.amplitude.max(), rel=0.06)
