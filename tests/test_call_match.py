"""Call match: recordings made with another call are reported, healthy ones are not."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench import budgets
from ertis_cli.main import cli

from ertis_numba.analysis.call_match import call_match, first_call_match
from ertis_numba.errors import CallMismatchWarning
from ertis_numba.frames import Measurement
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Recording, Settings
from ertis_numba.storage import open_energyscapes, write_recording
from ertis_numba.waveform import call_at

SETTINGS = Settings(
    recording=Recording(sample_rate_hz=450e3, n_samples=8100, encoding="float32"),
    processing=Processing(directions="2d:9", range_m=(0.5, 1.4), range_decimation=10),
)
CALL = SETTINGS.call
REVERSED = CALL.replace(start_frequency_hz=CALL.stop_frequency_hz, stop_frequency_hz=CALL.start_frequency_hz)


def heard(emitted, *, echoes=((6e-3, 1.0),), noise=0.0, seed=0, settings=SETTINGS):
    """Measurement of echoes ``(delay, amplitude)`` of a call that may differ from that of the settings."""
    random = np.random.default_rng(seed)
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    signal = np.zeros(len(time_s))
    for delay_s, amplitude in echoes:
        signal += amplitude * call_at(emitted, time_s - delay_s)
    words = 0.1 * (signal[:, None] + noise * random.standard_normal((len(time_s), 32)))
    return Measurement(words.astype(np.float32), settings)


@pytest.mark.parametrize("modulation", ["hyperbolic", "linear"])
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_call_match_finds_sweeps_of_the_opposite_direction(modulation, noise):
    settings = SETTINGS.replace(call=CALL.replace(modulation=modulation))
    found = call_match(heard(REVERSED.replace(modulation=modulation), noise=noise, settings=settings))
    assert not found.matches
    assert found.slope == pytest.approx(-1, abs=0.1)
    assert f"{modulation} sweep in the opposite direction" in found.warning


@pytest.mark.parametrize(
    "emitted", [CALL.replace(duration_s=5e-3), CALL.replace(duration_s=1.25e-3), CALL.replace(start_frequency_hz=80e3)]
)
def test_call_match_finds_other_presets(emitted):
    found = call_match(heard(emitted, noise=0.5))
    assert not found.matches
    assert "in the same direction" in found.warning


def test_call_match_accepts_the_call_beside_a_louder_reversed_one():
    both = heard(CALL).data + 3 * heard(REVERSED, echoes=((9e-3, 1.0),)).data
    assert call_match(Measurement(both, SETTINGS)).matches


@pytest.mark.parametrize("seed", range(3))
def test_call_match_accepts_many_echoes_of_the_call(seed):
    random = np.random.default_rng(seed)
    echoes = np.stack([random.uniform(1e-3, 14e-3, 60), random.standard_normal(60)], axis=1)
    assert call_match(heard(CALL, echoes=echoes, noise=0.1, seed=seed)).matches


@pytest.mark.parametrize("seed", range(5))
def test_call_match_accepts_random_settings_and_scenes(seed):
    measurement, _ = budgets.measurement_of(seed)
    found = call_match(measurement)
    assert found is None or found.matches


def test_call_match_does_not_judge_noise_and_silence():
    silent, noisy = heard(CALL, echoes=()), heard(CALL, echoes=(), noise=1.0)
    assert call_match(silent) is None
    assert call_match(noisy) is None
    assert not first_call_match([silent, noisy, heard(REVERSED)]).matches


def test_process_warns_of_another_call_on_stderr_and_in_the_file(tmp_path):
    write_recording(tmp_path / "rec.h5", [heard(REVERSED)])
    done = CliRunner().invoke(cli, ["process", str(tmp_path / "rec.h5"), "--json"])
    assert done.exit_code == 0, done.stderr
    with open_energyscapes(tmp_path / "rec.energy.h5") as images:
        assert "opposite direction" in images.call_warning
        assert images.call_warning in done.stderr
        assert images.call_warning == json.loads(done.stdout)["sensors"][0]["call_warning"]
    assert "opposite direction" in CliRunner().invoke(cli, ["info", str(tmp_path / "rec.energy.h5")]).stdout


def test_process_of_a_folder_names_the_recordings_of_another_call(tmp_path):
    runs, images = tmp_path / "runs", tmp_path / "images"
    runs.mkdir()
    for name, call in {"same": CALL, "other": REVERSED}.items():
        write_recording(runs / f"{name}.h5", [heard(call)])
    done = CliRunner().invoke(cli, ["process", str(runs), "-o", f"{images}/", "--workers", "1"])
    assert done.exit_code == 0, done.stderr
    (warning,) = (line for line in done.stderr.splitlines() if "do not match" in line)
    assert "other.h5" in warning
    with open_energyscapes(images / "other.energy.h5") as other, open_energyscapes(images / "same.energy.h5") as same:
        assert other.call_warning in warning
        assert not same.call_warning


def test_process_stores_no_warning_if_echoes_match(tmp_path):
    write_recording(tmp_path / "rec.h5", [heard(CALL)])
    done = CliRunner().invoke(cli, ["process", str(tmp_path / "rec.h5")])
    assert "do not match" not in done.stderr
    with open_energyscapes(tmp_path / "rec.energy.h5") as images:
        assert images.call_warning == ""


def test_pipelines_warn_once_of_another_call():
    with Pipeline(SETTINGS, "cpu", 1) as pipeline:
        with pytest.warns(CallMismatchWarning, match="opposite direction") as caught:
            pipeline.process(heard(REVERSED))
        pipeline.process(heard(REVERSED))
        assert [each.filename for each in caught if each.category is CallMismatchWarning] == [__file__]


def test_pipelines_without_prediction_do_not_compare_calls():
    with Pipeline(SETTINGS, "cpu", 1, predict=False) as pipeline:
        pipeline.process(heard(REVERSED))
