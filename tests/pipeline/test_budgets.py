"""Error budgets: kept, or exceeded with a warning on stderr and in the file, for every beamformer and dynamic range."""

import json
import subprocess

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.error_trials import budgets, reference_image
from ertis_bench.error_trials.random_settings import random_measurement
from ertis_cli.main import cli

from ertis_numba import kernels
from ertis_numba.base.errors import ErrorBudgetWarning
from ertis_numba.chain.planner import Planner
from ertis_numba.chain.sensitivity import Sensitivity
from ertis_numba.frames import Measurement
from ertis_numba.geometry import direction_grid, unit_vectors
from ertis_numba.geometry.waveform import call_at
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.pipeline.prediction import planner_of, predict
from ertis_numba.settings import Accuracy, Array, Call, Processing, Recording, Settings
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS
from ertis_numba.storage import open_energyscapes, write_recording

pytestmark = pytest.mark.usefixtures("sound_unchecked")

CPU = kernels.load("cpu")
PCM = Settings(
    call=Call(start_frequency_hz=60e3, stop_frequency_hz=25e3, duration_s=2e-3),
    recording=Recording(sample_rate_hz=450e3, n_samples=5400, encoding="float32"),
    processing=Processing(directions="2d:9", range_m=(0.5, 1.4), range_decimation=10),
)


def pcm(settings, *, direct=0.0, hum=0.0, echo=1e-5, n_mics=32):
    """A measurement of one echo, direct sound before the window, and a hum below the band."""
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    signal = direct * call_at(settings.call, time_s - 1e-4) + hum * np.sin(2 * np.pi * 1000 * time_s)
    signal += echo * call_at(settings.call, time_s - 6.2e-3)
    return Measurement(np.tile(signal[:, None], (1, n_mics)).astype(np.float32), settings)


def errors(measurement, **pipeline):
    """True and predicted error of the image, and the budget."""
    with Pipeline(measurement.settings, "cpu", 1, predict=False, **pipeline) as made:
        image = made.process(measurement)
    exact = verification.exact_image(image, measurement).amplitude
    return verification.error_db(image.amplitude, exact), predict(planner_of(image, measurement, CPU, threads=1))


@pytest.mark.parametrize("sound", ["direct", "hum"])
@pytest.mark.parametrize("budget_db", [-35.0, -70.0])
def test_sound_outside_the_window_does_not_wrap_into_pcm_images(sound, budget_db):
    settings = PCM.replace(accuracy=Accuracy(max_error_db=budget_db))
    true_db, predicted = errors(pcm(settings, **{sound: 0.5}))
    assert true_db <= budget_db or predicted.warning
    if budget_db == -35.0:
        assert true_db <= budget_db


@pytest.mark.parametrize("hum_hz", [50.0, 1203.0, 4711.0])
def test_hum_below_the_band_causes_no_needless_warning(hum_hz):
    """A transform rounds the hum 100 dB below; the images keep -35 dB, 70 dB below the hum."""
    settings = PCM.replace(accuracy=Accuracy(max_error_db=-35.0))
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    hum = 0.8 * np.sin(2 * np.pi * hum_hz * time_s)
    signals = pcm(settings, echo=3e-4).data + hum[:, None].astype(np.float32)
    signals += 1e-5 * np.random.default_rng(3).standard_normal(signals.shape).astype(np.float32)
    true_db, predicted = errors(Measurement(signals, settings))
    assert true_db <= -35.0
    assert not predicted.warning
    assert true_db < predicted.predicted_error_db + predicted.uncertainty_db


# Decimated by 1 to 22; calls of 0.06 to 0.6 ms, whose matched filters ring beyond the window.
@pytest.mark.parametrize("seed", [15, 58, 62, 68, 81, 139, 155, 158, 181, 184, 190])
@pytest.mark.parametrize("budget_db", [-60.0, -90.0])
def test_errors_of_exact_plans_for_short_calls_are_predicted(seed, budget_db):
    drawn = random_measurement(seed)
    settings = drawn.settings.replace(
        accuracy=Accuracy(max_error_db=budget_db, delay_taps=0),
        processing=drawn.settings.processing.replace(wavefront="plane"),
    )
    measurement = Measurement(drawn.data, settings)
    with Pipeline(settings, "cpu", 1, predict=False) as made:
        image = made.process(measurement)
    grid = direction_grid(settings.processing)
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    exact = reference_image.exact(drawn.data, settings, directions, image.range_m)
    true_db = verification.error_db(image.amplitude, exact)
    predicted = predict(planner_of(image, measurement, CPU, threads=1))
    assert true_db < predicted.predicted_error_db + predicted.uncertainty_db
    assert true_db > predicted.predicted_error_db - 12


@pytest.mark.parametrize("beamformer", ["delay_and_sum", "dmas"])
@pytest.mark.parametrize("exponent", [-100, 100])
def test_prediction_does_not_depend_on_the_magnitude_of_samples(beamformer, exponent):
    settings = PCM.replace(processing=PCM.processing.replace(beamformer=beamformer))
    given = pcm(settings, direct=0.5, echo=0.01)
    scaled = Measurement(np.ldexp(given.data, exponent), settings)
    with Pipeline(settings, "cpu", 1, predict=False) as made:
        wanted, found = (
            predict(planner_of(made.process(each), each, CPU, threads=1)).predicted_error_db for each in (given, scaled)
        )
    assert found == pytest.approx(wanted, abs=0.05)


def test_prediction_includes_rounding_of_loud_sound():
    settings = PCM.replace(accuracy=Accuracy(max_error_db=-100.0))
    true_db, predicted = errors(pcm(settings, direct=0.5, echo=1e-6))
    assert predicted.warning
    assert true_db - predicted.predicted_error_db < 3.0


@pytest.mark.parametrize("place_m", [(0.0, 0.0, 0.0), (0.0, 1e-3, 0.0)])
@pytest.mark.parametrize("budget_db", [-20.0, -35.0, -50.0])
def test_predictions_for_one_microphone_are_not_optimistic(place_m, budget_db):
    array = Array(layout="one", positions_m=(place_m,))
    settings = PCM.replace(array=array, accuracy=Accuracy(max_error_db=budget_db))
    true_db, predicted = errors(pcm(settings, echo=0.1, n_mics=1))
    assert true_db <= budget_db
    assert true_db - predicted.predicted_error_db < 1.0


@pytest.mark.parametrize(
    "processing", [{"beamformer": "dmas", "dmas_order": 8}, {"beamformer": "capon", "diagonal_loading": 1e-3}]
)
def test_budgets_of_adaptive_beamformers_are_kept_or_warned_of(processing):
    settings = PCM.replace(processing=PCM.processing.replace(**processing), accuracy=Accuracy(max_error_db=-35.0))
    true_db, predicted = errors(pcm(settings, echo=0.3))
    assert true_db <= -35.0 or predicted.warning


def test_sensitivity_has_an_inverse_and_makes_plans_more_exact():
    for beamformer, weighting in (("delay_and_sum", "none"), *ADAPTIVE_COMBINATIONS):
        processing = Processing(beamformer=beamformer, weighting=weighting, dmas_order=4, diagonal_loading=1e-2)
        sensitivity = Sensitivity.of(processing, 32)
        for power in (1e-10, 1e-5, 1e-2):
            assert sensitivity.output(sensitivity.beams(power)) == pytest.approx(power)
    plain = Planner(PCM, CPU, threads=1).choose()
    dmas = PCM.replace(processing=PCM.processing.replace(beamformer="dmas", dmas_order=4))
    chosen = Planner(dmas, CPU, threads=1).choose()
    assert chosen.error_db <= -35.0
    assert plain.error_db <= -35.0
    linear = Planner(chosen.settings, CPU, threads=1, sensitivity=Sensitivity()).chosen(chosen.settings.accuracy)
    assert linear.error_db == pytest.approx(chosen.error_db - 10 * np.log10(4))


def test_process_warns_on_stderr_and_in_the_file(tmp_path):
    settings = PCM.replace(accuracy=Accuracy(max_error_db=-100.0))
    quiet = pcm(settings, direct=0.5, echo=1e-6)
    write_recording(tmp_path / "quiet.h5", [quiet])
    target = tmp_path / "quiet.energy.h5"
    done = CliRunner().invoke(cli, ["process", str(tmp_path / "quiet.h5"), "--json"])
    assert done.exit_code == 0, done.stderr
    with open_energyscapes(target) as images:
        assert images.error_warning in done.stderr
        assert images.predicted_error_db > -100.0 == images.max_error_db
        assert images.error_warning == json.loads(done.stdout)["sensors"][0]["error_warning"]
    reported = CliRunner().invoke(cli, ["info", str(target)]).stdout
    assert "images may exceed the error budget" in reported


def test_process_prints_no_warning_if_the_budget_is_kept(tmp_path):
    write_recording(tmp_path / "loud.h5", [pcm(PCM, echo=0.3)])
    done = CliRunner().invoke(cli, ["process", str(tmp_path / "loud.h5")])
    assert done.exit_code == 0, done.stderr
    assert "exceed the error budget" not in done.stderr
    with open_energyscapes(tmp_path / "loud.energy.h5") as images:
        assert images.error_warning == ""
        assert images.predicted_error_db < images.max_error_db == -35.0


@pytest.fixture
def asked_here(monkeypatch):
    """Run the commands of a benchmark in this process, which is faster than starting one for each."""

    def ask(*arguments):
        done = CliRunner().invoke(cli, arguments)
        return subprocess.CompletedProcess(arguments, done.exit_code, done.stdout, done.stderr)

    monkeypatch.setattr(budgets, "ask", ask)


@pytest.mark.usefixtures("asked_here")
@pytest.mark.parametrize("seed", [39, 42, 415, 453])
def test_budgets_once_missed_silently_are_kept_or_warned_of(seed):
    """The causes were zones of two microphones, direct sound 110 dB above the image, and its rounding."""
    row = budgets.tried(seed)
    assert row is not None
    assert row["outcome"] != "missed"


@pytest.mark.usefixtures("asked_here")
def test_random_settings_keep_their_budget_or_are_warned_of():
    rows = [row for seed in range(5) if (row := budgets.tried(seed))]
    assert len(rows) >= 3
    assert not [row for row in rows if row["outcome"] == "missed"]


def test_process_suggests_verify_unless_it_was_given(tmp_path):
    settings = PCM.replace(accuracy=Accuracy(max_error_db=-100.0))
    write_recording(tmp_path / "quiet.h5", [pcm(settings, direct=0.5, echo=1e-6)])
    arguments = ["process", str(tmp_path / "quiet.h5"), "-o", str(tmp_path / "image.h5"), "--force"]
    assert "measure the error (--verify), or" in CliRunner().invoke(cli, arguments).stderr
    verified = CliRunner().invoke(cli, [*arguments, "--verify"])
    assert "use a lower --max-error" in verified.stderr
    assert "--verify" not in verified.stderr


def test_process_quiet_prints_neither_plan_nor_verification(tmp_path):
    fine = PCM.replace("processing.directions", "2d:61")  # A warning of a coarse grid is printed.
    write_recording(tmp_path / "loud.h5", [pcm(fine, echo=0.3)])
    done = CliRunner().invoke(cli, ["process", str(tmp_path / "loud.h5"), "--explain", "--verify", "--quiet"])
    assert (done.exit_code, done.output) == (0, "")


CAPON = PCM.processing.replace(beamformer="capon", diagonal_loading=1e-3, snapshots=8)


@pytest.mark.parametrize(
    ("processing", "budget_db", "scope"),
    [
        (PCM.processing, -35.0, "image"),
        (PCM.processing.replace(weighting="coherence_factor"), -35.0, "image"),
        (PCM.processing.replace(beamformer="dmas"), -35.0, "echoes"),
        (CAPON, -35.0, "beams"),
    ],
)
def test_files_and_reports_name_the_scope_of_the_budget(tmp_path, processing, budget_db, scope):
    settings = PCM.replace(processing=processing, accuracy=Accuracy(max_error_db=budget_db))
    write_recording(tmp_path / "rec.h5", [pcm(settings, echo=0.3)])
    done = CliRunner().invoke(cli, ["process", str(tmp_path / "rec.h5"), "--explain"])
    assert done.exit_code == 0, done.output
    with open_energyscapes(tmp_path / "rec.energy.h5") as images:
        assert images.budget_applies_to == scope
        warned = "for delay-and-sum beams only, not for images of capon" in images.error_warning
        assert warned == (scope == "beams" and images.error_warning != "")
    assert ("meets it for delay-and-sum beams of the same signals" in done.stderr) == (scope == "beams")
    assert ("images of noise, or of many overlapping echoes" in done.stderr) == (scope == "echoes")


@pytest.mark.parametrize("seed", [44, 118])
def test_adaptive_predictions_are_within_2_db_without_false_warnings(seed):
    """Predictions for these seeds were once 7 to 8 dB too low, and warnings appeared within 15 dB of the budget."""
    measurement, _ = budgets.measurement_of(seed)
    true_db, predicted = errors(measurement)
    assert abs(true_db - predicted.predicted_error_db) < predicted.uncertainty_db <= 2.0
    assert true_db < predicted.max_error_db - 5.0
    assert not predicted.warning


QUIET = pcm(PCM.replace(accuracy=Accuracy(max_error_db=-100.0)), direct=0.5, echo=1e-6)


def test_pipelines_warn_once_of_a_missed_budget():
    with Pipeline(QUIET.settings, "cpu", 1) as pipeline:
        assert pipeline.prediction is None
        with pytest.warns(ErrorBudgetWarning, match="images may exceed the error budget") as caught:
            pipeline.process(QUIET)
        pipeline.process_batch([QUIET, QUIET])
        [missed] = [each for each in caught if each.category is ErrorBudgetWarning]
        assert missed.filename == __file__
        assert pipeline.prediction.warning == str(missed.message)


def test_pipelines_do_not_warn_if_the_budget_is_kept_or_nothing_is_predicted():
    with Pipeline(PCM, "cpu", 1) as pipeline:
        pipeline.process(pcm(PCM, echo=0.3))
        assert pipeline.prediction.predicted_error_db < -35.0
    with Pipeline(QUIET.settings, "cpu", 1, predict=False) as pipeline:
        pipeline.process(QUIET)
        assert pipeline.prediction is None


def test_pipelines_predict_again_when_images_become_much_fainter():
    settings = QUIET.settings.replace(accuracy=Accuracy(max_error_db=-80.0))
    with Pipeline(settings, "cpu", 1) as pipeline:
        pipeline.process(pcm(settings, echo=0.3))
        first = pipeline.prediction
        assert not first.warning
        pipeline.process(pcm(settings, echo=0.2))
        assert pipeline.prediction is first
        with pytest.warns(ErrorBudgetWarning):
            pipeline.process(pcm(settings, direct=0.5, echo=1e-7))
        assert pipeline.prediction.predicted_error_db > first.predicted_error_db


def test_silence_is_not_predicted():
    with Pipeline(PCM, "cpu", 1) as pipeline:
        pipeline.process(pcm(PCM, echo=0.0))
        assert pipeline.prediction is None
