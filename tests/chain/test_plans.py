"""Accuracy plans on the command line: ``--explain``, ``--verify``, and error budgets that are not met."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.plans import in_words, plans
from ertis_cli.main import cli

from ertis_numba.base.errors import DataError
from ertis_numba.frames import Peak
from ertis_numba.geometry import unit_vectors
from ertis_numba.pipeline import verification
from ertis_numba.pipeline.verification import _peaks
from ertis_numba.settings import ERROR_PRESETS_DB, Accuracy
from ertis_numba.storage import open_energyscapes, write_recording
from tests import reference
from tests.files import SMALL, noise


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, ["process", *(str(argument) for argument in arguments)])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


def report(*arguments):
    done = run(*arguments, "--json")
    assert done.stdout.count("\n") == 1
    said = [line for line in done.stderr.splitlines() if ": directions are " not in line]
    assert not any("dB" in line for line in said)  # The JSON object contains the whole report.
    return json.loads(done.stdout)


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "rec.h5", noise(count=1))


def test_max_error_option_sets_the_budget_of_the_plan(recording, tmp_path):
    for given, wanted_db in [("-48.5", -48.5), *ERROR_PRESETS_DB.items()]:
        output = tmp_path / f"{given}.h5"
        run(recording, "-o", output, "--max-error", given)
        with open_energyscapes(output) as images:
            accuracy = images.settings.accuracy
        assert accuracy.max_error_db == wanted_db
        assert accuracy.oversampling is not None


def test_explain_prints_the_plan_as_json(recording, tmp_path):
    plan = report(recording, "-o", tmp_path / "a.h5", "--explain", "--max-error", -30)["plan"]
    assert plan["accuracy"]["max_error_db"] == -30
    assert plan["safe_db"] <= -30
    assert plan["predicted_db"] < plan["safe_db"]  # White noise is milder than the worst case.
    for total, key in (("safe_db", "safe_db"), ("predicted_db", "predicted_db")):
        parts = 10 * np.log10(sum(10 ** (part[key] / 10) for part in plan["parts"]))
        assert parts == pytest.approx(plan[total], abs=0.2)
    assert plan["time_ms"] == pytest.approx(sum(plan["stages_ms"].values()), abs=0.01)
    near, far = plan["plane_waves"]
    assert (near["range_m"], far["range_m"]) == (0.4, 0.9)
    # The phase error of plane waves falls with range.
    assert near["error_db"] - far["error_db"] == pytest.approx(20 * np.log10(0.9 / 0.4), abs=0.1)


def test_explain_prints_the_plan_as_text(recording, tmp_path):
    plain = run(recording, "-o", tmp_path / "a.h5", "--explain", "--directions", "2d:91")
    assert plain.stdout == ""
    lines = plain.stderr.splitlines()
    lines = [
        line for line in lines if not line.startswith(("ertis:", "note:", "eRTIS-7: the error of plane", str(tmp_path)))
    ]
    assert lines[0] == "plan of eRTIS-7 for an error budget of -35 dB:"
    assert "relative to spherical wavefronts" in plain.stderr
    assert any(line.startswith("    interpolation of delayed samples") for line in lines)
    assert any(line.startswith("    total") for line in lines)
    assert lines[-1].startswith("  predicted time")
    bent = run(recording, "-o", tmp_path / "b.h5", "--explain", "--wavefront", "spherical").stderr
    assert "spherical wavefronts, with separate delays in" in bent
    assert "relative to spherical wavefronts" not in bent
    assert "    one set of delays for each focal zone" in bent


def test_explain_names_the_given_parts_of_a_plan(recording, tmp_path):
    wishes = tmp_path / "wishes.toml"
    wishes.write_text('[accuracy]\ndelay_taps = 2\nbeam_taps = 0\nprecision = "float32"\n', "utf-8")
    reported = run(recording, "-o", tmp_path / "a.h5", "--explain", "--settings", wishes).stderr
    assert "single precision" in reported
    assert "a delayed sample is a weighted sum of 2 samples" in reported
    assert "the beam of every direction is summed directly" in reported
    wishes.write_text("[accuracy]\ndelay_taps = 0\n", "utf-8")
    reported = run(recording, "-o", tmp_path / "b.h5", "--explain", "--settings", wishes).stderr
    assert "single precision, exact delays, as phase shifts of spectra" in reported
    assert "interpolation of delayed samples" not in reported


@pytest.mark.parametrize("wavefront", ["plane", "spherical"])
def test_verify_prints_the_error_as_json(recording, tmp_path, wavefront):
    output = tmp_path / "a.h5"
    found = report(recording, "-o", output, "--verify", "--max-error", -50, "--wavefront", wavefront)["verified"]
    assert (found["max_error_db"], found["directions"], found["sequence"]) == (-50, 7, 10)
    (measurement,) = noise(count=1)
    with open_energyscapes(output) as images:
        image = images[0]
    vectors = unit_vectors(image.azimuth_rad, image.elevation_rad)
    wanted = reference.exact(measurement.data, SMALL, vectors, image.range_m, spherical=wavefront == "spherical")
    assert found["error_db"] == pytest.approx(reference.error_db(image.amplitude, wanted), abs=0.2)
    assert found["error_db"] <= found["safe_db"] <= -50
    assert -1 <= found["predicted_db"] - found["error_db"] <= 3
    assert found["peaks"]["wanted"] == 10
    assert found["peaks"]["lost"] == 0
    assert found["peaks"]["level_db"] < 0.1


def test_verify_prints_the_error_as_text(recording, tmp_path):
    reported = run(recording, "-o", tmp_path / "a.h5", "--verify").stderr.splitlines()
    others = ("eRTIS-7: the error of plane wavefronts", "ertis: warning: ")
    reported = [line for line in reported if not line.startswith(others)]
    assert reported[0].startswith("measurement 10 of eRTIS-7: error -")
    assert reported[0].endswith("allowed -35 dB")
    assert reported[1].startswith("  10 of the strongest 10 reflectors found, within ")


def test_plan_beyond_its_budget_is_refused(recording, tmp_path):
    output, wishes = tmp_path / "a.h5", tmp_path / "wishes.toml"
    wishes.write_text(
        '[accuracy]\nprecision = "float32"\noversampling = 2\ndelay_taps = 1\n'
        "beam_taps = 0\nbeam_density = 2.0\nstopband_attenuation_db = 60.0\nfocal_zones = 1\n",
        "utf-8",
    )
    done = run(recording, "-o", output, "--settings", wishes, code=1)
    last = done.stderr.splitlines()[-1]
    assert last.startswith("ertis: error: accuracy.max_error_db is -35, but the smallest error of these settings is -")
    assert last.endswith("or remove keys of [accuracy]")
    assert sorted(item.name for item in tmp_path.iterdir()) == ["rec.h5", "wishes.toml"]


def test_verify_writes_no_image_beyond_the_budget(recording, tmp_path, monkeypatch):
    """Replace the measured error, because predictions are conservative and real recordings stay within them."""
    measured = verification.Measured(error_db=-30.0, n_directions=7, peaks=None)
    monkeypatch.setattr(verification, "measure", lambda *_, **__: measured)
    output = tmp_path / "a.h5"
    done = CliRunner().invoke(cli, ["process", str(recording), "-o", str(output), "--verify"])
    assert done.exit_code == 1
    assert "sensor eRTIS-7 has an error of -30.0 dB, but the limit is -35 dB; use a lower --max-error" in done.stderr
    assert not output.exists()


def test_unreachable_budget_is_refused(recording, tmp_path):
    done = run(recording, "-o", tmp_path / "a.h5", "--max-error", -150, code=1)
    assert done.stderr.splitlines()[-1].startswith("ertis: error: --max-error is -150, but the smallest error")
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (["--max-error", "good"], "'good' is not an error budget; use dB, as in -40, or draft, standard, fine, exact"),
        (["--method", "paper", "--explain"], "--explain needs --method fast; method 'paper' has no plan"),
        (["--method", "paper", "--max-error", "fine"], "--max-error needs --method fast"),
        (["--method", "paper", "--plan", "nominal"], "--plan needs --method fast"),
    ],
)
def test_plan_options_need_the_fast_method(recording, arguments, reported):
    assert reported in run(recording, *arguments, code=2).stderr


def test_verify_refuses_a_silent_exact_image():
    with pytest.raises(DataError, match="the exact image is silent"):
        verification.error_db(np.ones((2, 3), np.float32), np.zeros((2, 3), np.float32))


def test_verified_error_of_nan_is_infinite():
    assert verification.error_db(np.full((1, 1), np.nan, np.float32), np.ones((1, 1), np.float32)) == np.inf


def test_verify_compares_each_peak_with_the_nearest(monkeypatch):
    def peak(azimuth_deg, range_m, level_db):
        return Peak(azimuth_deg=azimuth_deg, elevation_deg=0.0, range_m=range_m, level_db=level_db)

    found = [peak(0.5, 1.001, 0.0), peak(3.0, 1.0, -1.0), peak(40.0, 2.05, -3.0)]
    monkeypatch.setattr(_peaks, "peaks_of_grid", lambda *_, **__: found)
    errors = verification.peak_errors(None, [peak(0.0, 1.0, 0.0), peak(40.0, 2.0, -2.0), peak(4.0, 1.0, -3.0)])
    assert (errors.wanted, errors.lost) == (3, 1)  # A peak 5 cm away belongs to another reflector.
    assert errors.level_db == pytest.approx(2.0)
    assert errors.range_mm == pytest.approx(1.0)
    assert errors.angle_deg == pytest.approx(1.0)
    none = verification.peak_errors(None, [peak(-80.0, 1.0, 0.0)])
    assert (none.lost, none.level_db) == (1, None)


def test_plan_summary_names_all_choices():
    made = plans()
    assert len(made) >= 20
    assert len({in_words(plan) for plan in made}) == len(made)
    plan = Accuracy(
        precision="int16",
        oversampling=2,
        delay_taps=2,
        beam_taps=4,
        beam_density=1.75,
        stopband_attenuation_db=60.0,
        focal_zones=8,
    )
    assert in_words(plan) == "int16, 2 samples of 2 per range, beam grid 4 × 1.75, 60 dB, 8 zones"
