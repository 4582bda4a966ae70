"""Delay matrices of your own: images, storage and refusals."""

import re

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.geometry import (
    delay_matrix,
    direction_grid,
    far_field_delays,
    load_layout,
    microphones,
    received_settings,
    storable,
    unit_vectors,
)
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline import Pipeline
from ertis_numba.pipeline.verification import error_db, exact_image
from ertis_numba.settings import Call, Processing, Settings
from ertis_numba.storage import open_energyscapes, write_recording
from tests.cases import CASES, SHORT, noise
from tests.files import noise as measurements_of

RATE_HZ = 450_000.0
EXACT = {"accuracy.stopband_attenuation_db": 130.0, "accuracy.max_error_db": 0.0}


def plane_samples(settings, rate_hz=RATE_HZ):
    """Delays of plane waves at all channels, in samples: (direction, channel)."""
    grid = direction_grid(settings.processing)
    speed_m_s = sound_speed_m_s(settings.air)
    looks = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    return rate_hz * far_field_delays(microphones(settings.array).positions_m, looks, sound_speed_m_s=speed_m_s)


def random_samples(settings, *, largest=40.0):
    shape = len(direction_grid(settings.processing)), len(microphones(settings.array).enabled)
    return np.random.default_rng(5).uniform(-largest, largest, shape)


def given(samples, settings=SHORT, **changes):
    changes |= {"processing.delay_matrix": samples, "processing.delay_rate_hz": RATE_HZ}
    return settings.replace(**changes)


def image_of(settings, device="cpu"):
    with Pipeline(settings, device, predict=False) as pipeline:
        return pipeline.process(noise(settings))


@pytest.mark.parametrize("case", ["default", "solid angle", "calibrated", "array weights", "PCM, calibrated"])
@pytest.mark.parametrize("device", ["cpu", "numpy"])
def test_delays_of_plane_waves_give_the_same_image(case, device):
    settings = CASES[case].replace(**EXACT, **{"accuracy.delay_taps": 0})
    wanted, found = (image_of(each, device) for each in (settings, given(plane_samples(settings), settings)))
    assert error_db(found.amplitude, wanted.amplitude.astype(float)) < -100
    assert np.array_equal(found.range_m, wanted.range_m)


@pytest.mark.parametrize("device", ["cpu", "numpy"])
def test_delays_of_plane_waves_give_the_same_image_by_the_method_of_the_paper(device):
    settings = SHORT.replace("processing.method", "paper")
    wanted, found = (image_of(each, device) for each in (settings, given(plane_samples(settings), settings)))
    assert error_db(found.amplitude, wanted.amplitude.astype(float)) < -60  # A delay of half a sample may round.


@pytest.mark.parametrize("case", ["default", "solid angle", "calibrated", "array weights"])
@pytest.mark.parametrize("device", ["cpu", "numpy"])
def test_image_with_any_delays_is_exact(case, device):
    settings = given(random_samples(CASES[case]), CASES[case], **EXACT)
    image = image_of(settings, device)
    assert image.settings.accuracy.delay_taps == 0
    assert error_db(image.amplitude, exact_image(image, noise(settings)).amplitude) < -100


def test_beam_of_given_delays_adds_delayed_signals():
    """Whole samples at the rate of the signals need no interpolation. The decimation filter changes -51 dB."""
    settings = SHORT.replace(**{"processing.decimation": 10, "processing.range_decimation": 10, **EXACT})
    samples = np.rint(random_samples(settings))
    samples -= np.rint(samples.mean(axis=1, keepdims=True))
    settings = given(samples, settings, **{"processing.range_m": (0.41, 0.9)})
    with Pipeline(settings, "numpy", predict=False) as pipeline:
        beams, signals = pipeline.beams(noise(settings)), pipeline.signals(noise(settings))
    n_fft = signals.matched.shape[1]
    frequency_hz = np.fft.fftfreq(n_fft, 1 / RATE_HZ) % RATE_HZ
    mean_s = samples.mean(axis=1) / RATE_HZ
    for direction in (0, 3, 6):
        rows = [np.roll(row, -int(n)) for row, n in zip(signals.matched, samples[direction], strict=True)]
        at_s = 2 * beams.range_m[0] / signals.sound_speed_m_s - mean_s[direction]
        turned = np.fft.fft(np.mean(rows, axis=0)) * np.exp(2j * np.pi * frequency_hz * at_s)
        wanted = np.fft.ifft(turned)[: len(beams.range_m)]
        assert np.linalg.norm(beams.beam[direction] - wanted) < 5e-3 * np.linalg.norm(wanted)


def test_only_differences_between_microphones_matter():
    samples = random_samples(SHORT)
    found = [delay_matrix(given(each), n_directions=7) for each in (samples, samples + np.arange(7)[:, None])]
    np.testing.assert_allclose(found[0], found[1], atol=1e-12)
    np.testing.assert_allclose(found[0].mean(axis=1), 0, atol=1e-12)
    disabled = given(samples).replace("array.disabled", (3, 8))
    assert np.array_equal(delay_matrix(disabled, n_directions=7), np.delete(found[0], (3, 8), axis=1))
    assert delay_matrix(SHORT, n_directions=7) is None


def test_rate_of_the_delays_is_that_of_the_signals_by_default():
    settings = SHORT.replace("processing.delay_matrix", random_samples(SHORT))
    named = settings.replace("processing.delay_rate_hz", settings.signal_rate_hz)
    found = [delay_matrix(each, n_directions=7) for each in (settings, named)]
    assert np.array_equal(*found)


def test_image_with_given_delays_keeps_its_error_budget():
    settings = given(random_samples(SHORT), **{"accuracy.max_error_db": -60.0})
    with Pipeline(settings, "cpu") as pipeline:
        image = pipeline.process(noise(settings))
        assert pipeline.prediction.predicted_error_db <= -60
    assert error_db(image.amplitude, exact_image(image, noise(settings)).amplitude) < -60


@pytest.mark.parametrize("suffix", [".csv", ".npy"])
def test_delays_are_read_from_a_file_beside_the_settings(tmp_path, suffix):
    samples, name = random_samples(SHORT).round(3), f"delays{suffix}"
    if suffix == ".csv":
        np.savetxt(tmp_path / name, samples, delimiter=",", header="delays in samples")
    else:
        np.save(tmp_path / name, samples)
    text = f"processing.delay_matrix = '{name}'\nprocessing.delay_rate_hz = 450e3"
    (tmp_path / "mine.toml").write_text(text)
    write_recording(tmp_path / "rec.h5", measurements_of(SHORT, 1))
    arguments = ["process", str(tmp_path / "rec.h5"), "-o", str(tmp_path / "out.h5"), "-q", "--device", "cpu"]
    done = CliRunner().invoke(cli, [*arguments, "--settings", str(tmp_path / "mine.toml")])
    assert done.exit_code == 0, done.output
    with open_energyscapes(tmp_path / "out.h5") as images, Pipeline(given(samples), "cpu", predict=False) as pipeline:
        wanted = pipeline.process(measurements_of(SHORT, 1)[0])
        assert images[0].amplitude.tobytes() == wanted.amplitude.tobytes()
    with pytest.raises(
        SettingsError, match=r"processing.delay_matrix is 'delays.*, the name of a file; send its delays"
    ):
        received_settings(text, "a sensor")
    with pytest.raises(ArgumentError, match=r"processing.delay_matrix is the file .* a recording cannot contain files"):
        storable(Settings.load(tmp_path / "mine.toml"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"delay_matrix": ((1.0, 2.0), (3.0,))},
            "processing.delay_matrix has rows of 1 to 2 numbers; write one number for each",
        ),
        ({"delay_matrix": np.zeros((1000, 32))}, "lists 1000 × 32 numbers; the limit is 20000, so pass the name of a"),
        ({"delay_matrix": ((1.0,),), "beamformer": "dmas"}, "is given, which processing.beamformer 'dmas' does not"),
        (
            {"delay_matrix": ((1.0,),), "wavefront": "spherical"},
            "is given, which processing.wavefront 'spherical' does not support",
        ),
        ({"delay_rate_hz": 0.0}, "processing.delay_rate_hz is 0; use a number from 1"),
    ],
)
def test_unusable_matrices_are_refused_by_settings(changes, message):
    with pytest.raises(ArgumentError, match=message):
        Processing(**changes)


def test_damaged_header_of_an_npy_file_is_refused(tmp_path):
    """NumPy raises errors of other types for headers that end too early."""
    path = tmp_path / "cut.npy"
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000,), ".ljust(117) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(8000))
    with pytest.raises(ArgumentError, match=r"cut.npy cannot be read \(it is empty, or its header is damaged\)"):
        delay_matrix(given(str(path)), n_directions=3)
    with pytest.raises(SettingsError, match=r"cut.npy cannot be read \(it is empty, or its header is damaged\)"):
        Call.from_file(path, sample_rate_hz=450_000)
    with pytest.raises(ArgumentError, match=r"cut.npy is no array of NumPy"):
        load_layout(path)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (
            np.zeros((7, 31)),
            r"has shape \(7, 31\), but the image has 7 directions and the array 32 channels; pass shape",
        ),
        (np.zeros((32, 7)), r"pass shape \(7, 32\), a row for each direction; transpose it"),
        (np.full((7, 32), np.nan), r"processing.delay_matrix holds nan at \[0, 0\]; pass finite numbers"),
        (
            np.eye(7, 32) * 1e6,
            "delays of up to 2153 ms relative to the mean of their direction, but the limit is 20 ms",
        ),
        ("none.csv", "processing.delay_matrix none.csv cannot be read"),
        ("none.txt", "processing.delay_matrix none.txt is not a .csv or .npy file; use such a file, or a list of rows"),
    ],
)
def test_unusable_matrices_are_refused_by_pipelines(samples, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for method in ("fast", "paper"):
        with pytest.raises(ArgumentError, match=message):
            Pipeline(given(samples).replace("processing.method", method), "numpy")


def test_unreadable_files_are_refused(tmp_path):
    for name, content, message in (
        ("text.csv", "1,2\n3,x", "could not convert string to float: 'x'"),
        ("rows.csv", "1,2\n3", "has rows of different lengths"),
        ("text.npy", "no array", "cannot be read"),
        ("empty.npy", "", "cannot be read"),
    ):
        (tmp_path / name).write_text(content)
        with pytest.raises(ArgumentError, match=message):
            delay_matrix(given(str(tmp_path / name)), n_directions=2)
    np.save(tmp_path / "flat.npy", np.zeros(3))
    with pytest.raises(ArgumentError, match=r"flat.npy contains float64 of shape \(3,\); pass rows of real numbers"):
        delay_matrix(given(str(tmp_path / "flat.npy")), n_directions=3)


@pytest.mark.parametrize(
    ("key", "value", "accepted"),
    [("delay_taps", 2, "0"), ("precision", "int16", "'float32'"), ("oversampling", 2, "1"), ("beam_taps", 2, "0")],
)
def test_plans_with_other_delays_are_refused_with_a_matrix(key, value, accepted):
    message = f"accuracy.{key} is {value!r}, but processing.delay_matrix needs exact delays; leave {key} out or use "
    with pytest.raises(ArgumentError, match=re.escape(message + accepted)):
        given(random_samples(SHORT)).replace(f"accuracy.{key}", value)
