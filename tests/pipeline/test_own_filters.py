"""Own FIR filters, combined with the matched filter: images, signals, settings and files."""

import numpy as np
import pytest
import scipy
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.chain.signals import matched
from ertis_numba.geometry import received_settings
from ertis_numba.geometry.waveform import call_spectrum, matched_filter_spectrum
from ertis_numba.pipeline import Pipeline
from ertis_numba.pipeline.prediction import UNCERTAINTY_DB
from ertis_numba.pipeline.verification import error_db, exact_image, measure
from ertis_numba.settings import Call, Processing, Settings
from ertis_numba.storage import open_energyscapes, write_recording
from tests.analysis.test_call_match import CALL, SETTINGS as ECHO_SETTINGS, heard
from tests.cases import SHORT, noise
from tests.files import noise as measurements_of

RATE_HZ = 450_000.0
LOWER_HALF = tuple(scipy.signal.firwin(101, (25e3, 37e3), fs=RATE_HZ, pass_zero=False).tolist())
UPWARDS = tuple(scipy.signal.firwin(64, 30e3, fs=RATE_HZ, pass_zero=True).tolist())  # an even number of taps
SKEWED = (1.0, -0.6, 0.3, 0.1)
KINDS = {
    "pre": {"pre_filter": LOWER_HALF, "filter_rate_hz": RATE_HZ},
    "post": {"post_filter": LOWER_HALF, "filter_rate_hz": RATE_HZ},
    "both": {"pre_filter": UPWARDS, "post_filter": LOWER_HALF, "filter_rate_hz": RATE_HZ},
    "asymmetric, at the rate of the signals": {"pre_filter": SKEWED},
    "loud": {"pre_filter": tuple(1000 * tap for tap in LOWER_HALF), "filter_rate_hz": RATE_HZ},
}
EXACT = {"accuracy.delay_taps": 0, "accuracy.stopband_attenuation_db": 130.0, "accuracy.max_error_db": 0.0}


def filtered(kind, settings=SHORT):
    return settings.replace(processing=settings.processing.replace(**KINDS[kind]))


def decibels(difference, wanted):
    return 20 * np.log10(np.linalg.norm(difference) / np.linalg.norm(wanted))


def mean_delay(taps):
    """Group delay by SciPy in samples, weighted by the power that the filter passes: half of symmetric lengths."""
    frequency, delay = scipy.signal.group_delay(
        (taps, 1), 4095, whole=True
    )  # without half of the sample rate, where it may be 0
    power = np.abs(scipy.signal.freqz(taps, worN=frequency)[1]) ** 2
    return np.sum(power * delay) / np.sum(power)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("device", ["cpu", "numpy"])
def test_image_equals_the_exact_one(kind, device):
    settings = filtered(kind).replace(**EXACT)
    measurement = noise(settings)
    with Pipeline(settings, device, predict=False) as pipeline:
        image = pipeline.process(measurement)
    assert error_db(image.amplitude, exact_image(image, measurement).amplitude) < -100
    plain = exact_image(image.replace(settings=SHORT.replace(**EXACT)), measurement)
    assert error_db(image.amplitude, plain.amplitude) > -20  # The filter matters.


@pytest.mark.parametrize("kind", KINDS)
def test_matched_signals_equal_those_of_a_convolution(kind):
    """The test filters in the time domain in float64, removes the mean group delay, and compensates the gain."""
    settings = filtered(kind).replace(**{"processing.decimation": 10, "processing.range_decimation": 100})
    with Pipeline(settings, "numpy", predict=False) as pipeline:
        signals = pipeline.signals(noise(settings))
    assert settings.signal_rate_hz == RATE_HZ
    given = KINDS[kind]
    taps = np.convolve(given.get("pre_filter", (1.0,)), given.get("post_filter", (1.0,)))
    padded = np.pad(signals.demodulated.astype(float), ((0, 0), (2000, 2000)))
    convolved = scipy.signal.fftconvolve(padded, taps[None, :])
    plain = settings.replace(processing=settings.processing.replace(pre_filter=(), post_filter=()))
    n_fft = 4 * convolved.shape[1]
    spectrum = matched_filter_spectrum(plain, n_fft=n_fft)
    frequency_hz = (spectrum.first_bin + np.arange(len(spectrum.values))) * RATE_HZ / n_fft
    # g Σ |S|² W |F| = n_fft, and without filters g Σ |S|² W = n_fft.
    inside = slice(spectrum.first_bin, spectrum.first_bin + len(frequency_hz))
    power = np.abs(call_spectrum(plain.call, plain, n_fft=n_fft)[inside] * spectrum.values)
    gain = power.sum() / np.sum(power * np.abs(scipy.signal.freqz(taps, worN=frequency_hz, fs=RATE_HZ)[1]))
    spectra = scipy.fft.fft(convolved, n_fft, axis=1)
    out = np.zeros_like(spectra)
    advance = np.exp(2j * np.pi * frequency_hz * (2000 + mean_delay(taps)) / RATE_HZ)
    out[:, inside] = spectra[:, inside] * spectrum.values * advance * gain
    wanted = scipy.fft.ifft(out, axis=1)[:, : signals.matched.shape[1]]
    assert decibels(signals.matched - wanted, wanted) < -100
    unfiltered = matched(signals.demodulated, plain)
    assert decibels(signals.matched - unfiltered, unfiltered) > -30


def test_symmetric_filters_move_no_echo_and_keep_its_amplitude():
    measurement = heard(CALL, echoes=((6e-3, 1.0),))
    found = []
    for settings in (ECHO_SETTINGS, filtered("both", ECHO_SETTINGS), filtered("loud", ECHO_SETTINGS)):
        with Pipeline(settings, "numpy", predict=False) as pipeline:
            signals = pipeline.signals(type(measurement)(measurement.data, settings))
        envelope = np.abs(signals.matched[3])
        found.append((signals.time_s[envelope.argmax()], envelope.max()))
    for time_s, peak in found[1:]:
        assert time_s == pytest.approx(found[0][0], abs=2 / ECHO_SETTINGS.signal_rate_hz)
        assert peak == pytest.approx(found[0][1], rel=0.05)


@pytest.mark.parametrize(
    "taps",
    [
        (*LOWER_HALF, *(0.0,) * 60),
        (0.0, 0.0, 1.0),
        tuple(scipy.signal.minimum_phase(scipy.signal.firwin(151, (20e3, 60e3), fs=RATE_HZ, pass_zero=False)).tolist()),
    ],
    ids=["zeros behind", "delay only", "minimum phase"],
)
def test_filters_that_are_not_symmetric_move_echoes_by_less_than_two_millimetres(taps):
    processing = ECHO_SETTINGS.processing.replace(pre_filter=taps, filter_rate_hz=RATE_HZ)
    measurement, found = heard(CALL, echoes=((6e-3, 1.0),)), []
    for settings in (ECHO_SETTINGS, ECHO_SETTINGS.replace(processing=processing)):
        with Pipeline(settings, "numpy", predict=False) as pipeline:
            signals = pipeline.signals(type(measurement)(measurement.data, settings))
        found.append(signals.time_s[np.abs(signals.matched[3]).argmax()])
    assert 0.5 * 343.2 * abs(found[1] - found[0]) < 2e-3


@pytest.mark.parametrize("weighting", ["none", "coherence_factor"])
def test_filtered_images_keep_their_error_budget(weighting):
    settings = filtered("pre").replace(**{"processing.weighting": weighting, "accuracy.max_error_db": -40.0})
    measurement = noise(settings)
    with Pipeline(settings, "cpu") as pipeline:
        image = pipeline.process(measurement)
        predicted_db = pipeline.prediction.predicted_error_db
    found_db = measure(image, measurement).error_db
    assert found_db < -40
    assert found_db < predicted_db + 2 * UNCERTAINTY_DB


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pre_filter": (0.0,) * 9}, "processing.pre_filter contains only 0; choose other taps, or leave it out"),
        ({"post_filter": (1.0,) * 1025}, "processing.post_filter has 1025 taps; the limit is 1024"),
        ({"pre_filter": (1.0, float("nan"))}, r"processing.pre_filter\[1\] is nan"),
        (
            {"pre_filter": (1.0, 2.0), "method": "paper"},
            "processing.pre_filter is not supported by processing.method 'p",
        ),
        (
            {"post_filter": (1.0, 2.0), "beamformer": "dmas"},
            "post_filter filters beams, but processing.beamformer 'dmas'",
        ),
        ({"filter_rate_hz": -1.0}, "processing.filter_rate_hz is -1; use a number from 1 to 1e"),
        (
            {"pre_filter": (1.0,), "filter_rate_hz": 90e3},
            "filter_rate_hz is 90000; use more than twice the call's 50000",
        ),
        (
            {
                "pre_filter": tuple(scipy.signal.firwin(301, 5e3, fs=RATE_HZ, window=("kaiser", 14.0))),
                "filter_rate_hz": RATE_HZ,
            },
            "pre_filter and post_filter remove the band of the call, 25000 to 50000 Hz; use filters that pass it",
        ),
    ],
)
def test_unusable_filters_are_refused(changes, message):
    with pytest.raises(ArgumentError, match=message):
        Settings(processing=Processing(**changes))


def test_taps_may_be_an_array():
    assert Processing(pre_filter=np.float32([0.5, 0.25])).pre_filter == (0.5, 0.25)


@pytest.mark.parametrize("suffix", [".csv", ".npy"])
def test_taps_are_read_from_a_file_beside_the_settings(tmp_path, suffix):
    if suffix == ".csv":
        (tmp_path / "taps.csv").write_text("# low pass\n" + "\n".join(map(repr, UPWARDS)))
    else:
        np.save(tmp_path / "taps.npy", UPWARDS)
    text = f"[processing]\npre_filter = 'taps{suffix}'\nfilter_rate_hz = 450e3"
    (tmp_path / "mine.toml").write_text(text)
    assert Settings.load(tmp_path / "mine.toml").processing.pre_filter == UPWARDS
    assert SHORT.updated_from_file(tmp_path / "mine.toml").processing == SHORT.processing.replace(
        pre_filter=UPWARDS, filter_rate_hz=450e3
    )
    write_recording(tmp_path / "rec.h5", measurements_of(SHORT, 1))
    arguments = ["process", str(tmp_path / "rec.h5"), "-o", str(tmp_path / "out.h5"), "-q"]
    done = CliRunner().invoke(cli, [*arguments, "--settings", str(tmp_path / "mine.toml")])
    assert done.exit_code == 0, done.output
    with open_energyscapes(tmp_path / "out.h5") as images:
        assert images.settings.processing.pre_filter == UPWARDS
    with pytest.raises(SettingsError, match=r"processing.pre_filter is 'taps.*, the name of a file; send its taps"):
        received_settings(text, "a sensor")
    with pytest.raises(ArgumentError, match=r"pre_filter is the file 'taps.*, which has not been read; set its"):
        Pipeline(Settings.from_toml(text), "numpy")


def test_missing_files_of_filters_are_refused(tmp_path):
    (tmp_path / "mine.toml").write_text("processing.post_filter = 'none.csv'")
    with pytest.raises(SettingsError, match=r"processing.post_filter .*none.csv: no such file"):
        Settings.load(tmp_path / "mine.toml")


def test_filters_suit_the_band_of_another_call():
    wide = Settings(call=Call(start_frequency_hz=80e3, stop_frequency_hz=20e3))
    assert wide.replace(processing=wide.processing.replace(**KINDS["pre"])).processing.pre_filter == LOWER_HALF
