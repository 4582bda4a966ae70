"""The image verifier equals a slow reference, including cases where former images were wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.error_trials import reference_image, verify_trials as campaign
from ertis_bench.error_trials.random_settings import DrawLimits, random_measurement, random_settings
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import unit_vectors
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.pipeline.verification import ExactImage, _measured
from ertis_numba.settings import Array, Call, Processing, Recording
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS, BEAMFORMERS, WEIGHTINGS
from ertis_numba.storage import open_energyscapes, open_recording, write_recording
from tests import reference
from tests.files import SMALL, noise

pytestmark = pytest.mark.usefixtures("sound_unchecked")

REFLECTORS = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
FIVE = Processing(directions="2d:5", range_m=(0.4, 1.0))
CALIBRATED = Array(
    layout="crooked",
    positions_m=tuple(map(tuple, np.random.default_rng(3).uniform(-0.03, 0.03, (5, 3)).tolist())),
    enabled=(True, True, False, True, True),
    gain=(1.0, 0.7, 1.0, 1.4, 1.1),
    delay_s=(0.0, 1e-6, 0.0, -2e-6, 3e-6),
    word_bits=8,
)
PCM = Recording(sample_rate_hz=450e3, n_samples=6_000, encoding="int16")


def small(**changes):
    return SMALL.replace(processing=FIVE).replace(**changes)


def measurement_of(settings, seed=1):
    """White noise in the encoding of the settings."""
    if settings.recording.is_pdm:
        return noise(settings, count=1, seed=seed)[0]
    shape = settings.recording.n_samples, len(settings.array.positions_m or range(32))
    return Measurement(np.random.default_rng(seed).integers(-9_000, 9_000, shape, dtype=np.int16), settings)


def wanted_of(image, measurement):
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    return reference_image.exact(measurement.data, image.settings, directions, image.range_m)


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param(small(), id="default call"),
        pytest.param(small(call=Call(duration_s=2e-4, ramp_fraction=0.0)), id="short call without a ramp"),
        pytest.param(small(array=CALIBRATED), id="calibrated array"),
        pytest.param(small(recording=PCM, processing=FIVE.replace(range_decimation=10)), id="PCM"),
        pytest.param(small(processing=FIVE.replace(wavefront="spherical", range_m=(0.0, 0.6))), id="spherical"),
        pytest.param(small(processing=FIVE.replace(band_edges_hz=(5e3, 90e3))), id="wide band"),
        pytest.param(small(processing=FIVE.replace(weighting="coherence_factor")), id="coherence factor"),
        pytest.param(small(processing=FIVE.replace(beamformer="dmas", dmas_order=3), array=CALIBRATED), id="dmas"),
        pytest.param(
            small(processing=FIVE.replace(beamformer="dmas", weighting="coherence_factor")), id="weighted dmas"
        ),
        pytest.param(small(processing=FIVE.replace(beamformer="capon", diagonal_loading=1e-3)), id="capon"),
    ],
)
def test_exact_image_agrees_with_referee(settings):
    measurement = measurement_of(settings)
    image = Pipeline(settings, "cpu", 1, max_error_db=0.0, predict=False).process(measurement)
    exact = ExactImage(image, measurement)
    found = np.stack([exact.amplitudes(direction, np.arange(len(image.range_m))) for direction in range(5)])
    assert reference.error_db(found, wanted_of(image, measurement)) < -140


def test_default_band_edges_are_5_khz_outside_the_call():
    measurement = measurement_of(small())
    images = [
        Pipeline(small(processing=FIVE.replace(band_edges_hz=edges_hz)), "cpu", 1, predict=False)
        .process(measurement)
        .amplitude
        for edges_hz in (None, (20e3, 55e3))
    ]
    np.testing.assert_array_equal(*images)


def test_band_edges_go_from_a_settings_file_into_the_energyscape_file(tmp_path):
    recording = write_recording(tmp_path / "rec.h5", noise(count=1))
    (tmp_path / "wide.toml").write_text("[processing]\nband_edges_hz = [5000, 90000]\n", "utf-8")
    arguments = ["-o", str(tmp_path / "a.h5"), "--settings", str(tmp_path / "wide.toml"), "--verify", "--json"]
    done = CliRunner().invoke(cli, ["process", str(recording), *arguments])
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout)["sensors"][0]["verified"]["error_db"] < -35
    with open_energyscapes(tmp_path / "a.h5") as images:
        assert images.settings.processing.band_edges_hz == (5e3, 90e3)


@pytest.mark.parametrize(
    ("settings", "budget_db"),
    [
        (small(call=Call(duration_s=1e-3, ramp_fraction=0.0)), -100),
        (small(call=Call(duration_s=1e-4, ramp_fraction=0.0)), -60),
        (small(call=Call(duration_s=5e-5)), -35),
        (small(call=Call(ramp_fraction=0.0), recording=PCM, processing=FIVE.replace(range_decimation=10)), -100),
    ],
    ids=["1 ms without a ramp", "0.1 ms without a ramp", "0.05 ms", "PCM without a ramp"],
)
def test_images_of_short_and_rampless_calls_keep_their_budgets(settings, budget_db):
    """The matched filter once used an aliased spectrum of the call, with errors of up to 75 dB."""
    measurement = measurement_of(settings)
    image = Pipeline(settings, "cpu", 1, max_error_db=budget_db, predict=False).process(measurement)
    true_db = reference.error_db(image.amplitude, wanted_of(image, measurement))
    assert true_db <= budget_db
    assert verification.measure(image, measurement).error_db == pytest.approx(true_db, abs=0.1)


def test_verify_measures_errors_of_spherical_images(tmp_path):
    """It once refused this image because of an error of -27.9 dB in its own exact image."""
    output = tmp_path / "a.h5"
    arguments = ["--wavefront", "spherical", "--range", "0:2", "--max-error", "-35", "--directions", "2d:5"]
    done = CliRunner().invoke(cli, ["process", str(REFLECTORS), "-o", str(output), "--verify", "--json", *arguments])
    assert done.exit_code == 0, done.stderr
    (sensor,) = json.loads(done.stdout)["sensors"]
    assert sensor["verified"]["error_db"] < -55
    assert sensor["verified"]["peaks"]["lost"] == 0


@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_verify_measures_errors_of_every_beamformer(tmp_path, beamformer, weighting):
    recording = write_recording(tmp_path / "rec.h5", noise(count=1))
    arguments = [
        "-o",
        str(tmp_path / "a.h5"),
        "--beamformer",
        beamformer,
        "--weighting",
        weighting,
        "--max-error",
        "0",
        "--verify",
        "--json",
    ]
    done = CliRunner().invoke(cli, ["process", str(recording), *arguments])
    assert done.exit_code == 0, done.stderr
    (sensor,) = json.loads(done.stdout)["sensors"]
    (measurement,) = noise(count=1)
    settings = SMALL.replace(processing=SMALL.processing.replace(beamformer=beamformer, weighting=weighting))
    image = Pipeline(settings, max_error_db=0, predict=False).process(measurement)
    true_db = reference.error_db(image.amplitude, wanted_of(image, measurement))
    assert sensor["verified"]["error_db"] == pytest.approx(true_db, abs=0.05)


@pytest.mark.parametrize(("beamformer", "weighting"), ADAPTIVE_COMBINATIONS)
def test_silence_gives_amplitudes_of_zero(beamformer, weighting):
    settings = small(
        recording=PCM, processing=FIVE.replace(range_decimation=10, beamformer=beamformer, weighting=weighting)
    )
    measurement = Measurement(np.zeros((PCM.n_samples, 32), dtype=np.int16), settings)
    image = Pipeline(settings, "cpu", 1, max_error_db=0, predict=False).process(measurement)
    assert not ExactImage(image, measurement).amplitudes(2, np.arange(len(image.range_m))).any()


@pytest.mark.parametrize(("wavefront", "n_sampled"), [("plane", 80), ("spherical", 8)])
def test_sampled_places_represent_all(monkeypatch, wavefront, n_sampled):
    """A few sampled places give the error of all, because bright ones are drawn more often."""
    with open_recording(REFLECTORS) as recording:
        measurement = recording[0]
    directions, range_m = ("2d:181", (0.5, 2.0)) if wavefront == "plane" else ("2d:25", (0.9, 1.3))
    processing = measurement.settings.processing.replace(directions=directions, range_m=range_m, wavefront=wavefront)
    image = Pipeline(measurement.settings.replace(processing=processing), predict=False).process(measurement)
    whole = verification.measure(image, measurement)
    assert whole.n_directions == len(image.amplitude)
    assert whole.peaks.lost == 0
    operations = ExactImage(image, measurement).operations_per_direction
    monkeypatch.setattr(_measured, "_MAX_OPERATIONS", n_sampled * operations)
    some = verification.measure(image, measurement)
    assert some.peaks is None
    assert (some.n_directions <= n_sampled) == (wavefront == "plane")
    assert some.error_db == pytest.approx(whole.error_db, abs=0.5)


def test_sample_weights_add_up_to_the_total():
    power = np.random.default_rng(1).uniform(0, 1, 50) ** 4
    chosen, weights = _measured.sampled(power, 500)
    assert chosen.tolist() == list(range(50))
    assert weights == pytest.approx(1.0, abs=0.15)
    for unknown in (np.zeros(50), np.full(50, np.nan)):
        chosen, weights = _measured.sampled(unknown, 10)
        assert len(chosen) == 10
        assert weights.sum() == pytest.approx(50)


@pytest.mark.filterwarnings("ignore:echoes do not show whether")  # Random calls may be too short to compare.
@pytest.mark.parametrize("seed", range(10))
def test_verified_errors_match_the_referee_for_random_settings(seed):
    """Short form of `ertis bench verification`."""
    found = campaign.compared(seed)
    assert not found["wrong"], found


def test_bench_verification_reports_every_kind_of_setting(tmp_path):
    target = tmp_path / "page.md"
    target.write_text("<!-- ertis bench verification -->\n<!-- /ertis bench verification -->\n", "utf-8")
    done = CliRunner().invoke(cli, ["bench", "verification", "--count", "2", "--json", "--update", str(target)])
    assert done.exit_code == 0, done.stderr
    assert [row["seed"] for row in json.loads(done.stdout)["rows"]] == [0, 1]
    assert "\n| all | 2 | 2 | 0 |" in target.read_text("utf-8")


def test_bench_verification_names_the_error(monkeypatch):
    monkeypatch.setattr(verification, "measure", lambda *_: verification.Measured(-90.0, 1, None))
    stated = []
    (row,) = campaign.run(count=1, seed=1, say=stated.append)["rows"]
    assert row["wrong"]
    assert stated == [f"seed 1: verified -90.00 dB, true {row['true_db']:.2f} dB"]


def test_random_settings_cover_every_kind():
    drawn = [random_settings(np.random.default_rng(seed), DrawLimits()) for seed in range(60)]
    assert {settings.processing.beamformer for settings in drawn} == set(BEAMFORMERS)
    assert {settings.processing.weighting for settings in drawn} == set(WEIGHTINGS)
    shapes = {(settings.processing.wavefront, settings.processing.is_adaptive) for settings in drawn}
    assert shapes == {(shape, adaptive) for shape in ("plane", "spherical") for adaptive in (False, True)}
    assert {settings.recording.encoding for settings in drawn} == {"pdm", "int16", "float32"}
    assert sum(settings.call.ramp_fraction == 0 for settings in drawn) > 10
    assert random_measurement(7).data.tobytes() == random_measurement(7).data.tobytes()


def test_random_settings_refuse_impossible_limits():
    with pytest.raises(ArgumentError, match=r"100 draws gave no valid settings; the last error: .*Widen the limits"):
        random_settings(np.random.default_rng(1), DrawLimits(max_samples=0))
