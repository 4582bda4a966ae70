"""Results of each stage of processing: signals, beams and images, in Python and in files."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Beams, Energyscape, MicrophoneSignals, Stamp
from ertis_numba.network.processing.shared_pipeline import SharedPipeline
from ertis_numba.pipeline import Pipeline
from ertis_numba.pipeline.verification import error_db, exact_image
from ertis_numba.pipeline.verification._exact import ExactImage
from ertis_numba.settings import STAGES, Processing, Settings
from ertis_numba.storage import write_recording
from tests.cases import CASES, SHORT, noise
from tests.files import noise as measurements_of

DEVICES = ["cpu", "numpy"]
FINE = SHORT.replace("accuracy.max_error_db", -70.0)


def ending(stage, settings=FINE):
    return settings.replace("processing.last_stage", stage)


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, list(map(str, arguments)))
    assert done.exit_code == code, done.output
    return done


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("case", ["default", "solid angle", "calibrated", "array weights", "PCM, calibrated"])
def test_magnitude_of_beams_is_the_exact_image(case, device):
    settings = CASES[case].replace("accuracy.max_error_db", -70.0)
    measurement = noise(settings)
    with Pipeline(settings, device, predict=False) as pipeline:
        beams = pipeline.beams(measurement)
        image = pipeline.process(measurement)
    assert beams.beam.dtype == np.complex64
    assert beams.stamp == measurement.stamp
    for name in ("azimuth_rad", "elevation_rad", "range_m"):
        assert np.array_equal(getattr(beams, name), getattr(image, name))
    exact = exact_image(image, measurement)
    assert error_db(beams.envelope().amplitude, exact.amplitude) < -70
    assert beams.envelope().settings.processing == image.settings.processing


@pytest.mark.parametrize("case", ["default", "solid angle", "calibrated"])
def test_phase_of_beams_is_exact(case):
    settings = CASES[case].replace("accuracy.max_error_db", -70.0)
    measurement = noise(settings)
    with Pipeline(settings, "cpu", predict=False) as pipeline:
        beams, image = pipeline.beams(measurement), pipeline.process(measurement)
    exact = ExactImage(image, measurement)
    wanted = np.stack([exact._plane(direction).mean(axis=0) for direction in range(len(beams.beam))])  # noqa: SLF001
    assert np.linalg.norm(beams.beam - wanted) < 10 ** (-70 / 20) * np.linalg.norm(wanted)


def test_beams_of_focal_zones_have_spherical_wavefronts():
    settings = FINE.replace("processing.wavefront", "spherical")
    measurement = noise(settings)
    with Pipeline(settings, "cpu", predict=False) as pipeline:
        beams, image = pipeline.beams(measurement), pipeline.process(measurement)
    assert error_db(beams.envelope().amplitude, exact_image(image, measurement).amplitude) < -70


def test_large_samples_scale_beams_as_they_scale_images():
    settings = CASES["PCM, calibrated"]
    measurement = noise(settings)
    loud = type(measurement)(measurement.data * np.float32(2.0**100), settings, measurement.stamp)
    with Pipeline(settings, "cpu", predict=False) as pipeline:
        wanted = pipeline.beams(measurement).beam
        assert np.allclose(pipeline.beams(loud).beam / np.float32(2.0**100), wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("stage", "kind"), [*zip(STAGES, (MicrophoneSignals, MicrophoneSignals, Beams, Energyscape), strict=True)]
)
def test_result_is_that_of_the_last_stage(stage, kind):
    with Pipeline(ending(stage), "cpu", predict=False) as pipeline:
        result = pipeline.result(noise(FINE))
        assert type(result) is kind
        if stage == "envelope":
            return
        refusal = rf"processing.last_stage is '{stage}', which yields no image; use 'envelope', or call"
        for call in (pipeline.process, lambda each: pipeline.process_batch([each]), pipeline.process_many):
            with pytest.raises(ArgumentError, match=refusal):
                call(noise(FINE))
    with pytest.raises(ArgumentError, match=refusal):
        SharedPipeline(ending(stage).to_toml(), "cpu")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Processing(last_stage="image"), "processing.last_stage 'image' is unknown; known are demodulation"),
        (
            lambda: Processing(last_stage="beams", beamformer="dmas"),
            "processing.last_stage is 'beams', but processing.beamformer 'dmas' combines signals to amplitudes without",
        ),
        (
            lambda: Processing(last_stage="beams", method="paper"),
            "processing.last_stage is 'beams', but processing.method 'paper' returns none; use method 'fast'",
        ),
        (
            lambda: Pipeline(SHORT.replace("processing.method", "paper"), "numpy").beams(noise(SHORT)),
            "beams are needed, but processing.method 'paper' returns none",
        ),
        (lambda: Beams(np.zeros((2, 3), np.complex64), *np.zeros((3, 2)), SHORT), "beam has shape"),
    ],
)
def test_beams_that_do_not_exist_are_refused(make, message):
    with pytest.raises(ArgumentError, match=message):
        make()


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("stages") / "rec.h5"
    write_recording(path, measurements_of(FINE, 3))
    return path


@pytest.mark.parametrize(
    ("stage", "name"), [("demodulation", "demodulated"), ("matched_filter", "matched"), ("beams", "beam")]
)
def test_process_command_writes_the_results_of_a_stage(recording, tmp_path, stage, name):
    target = tmp_path / "out.npz"
    done = run("process", recording, "-o", target, "--last-stage", stage, "--json", "-q")
    report = {"output": str(target), "sensor": "eRTIS-7", "last_stage": stage, "measurements": 3}
    assert json.loads(done.stdout) == report
    settings = tmp_path / "settings.toml"
    settings.write_text(f"processing.last_stage = '{stage}'")
    run("process", recording, "-o", tmp_path / "same.npz", "--settings", settings, "-q")
    assert (tmp_path / "same.npz").read_bytes() == target.read_bytes()
    measurements = measurements_of(FINE, 3)
    with Pipeline(ending(stage), "cpu", predict=False) as pipeline, np.load(target, allow_pickle=False) as data:
        results = [pipeline.result(each) for each in measurements]
        assert data[name].tobytes() == np.stack([getattr(each, name) for each in results]).tobytes()
        axes = ("azimuth_rad", "elevation_rad", "range_m") if stage == "beams" else ("time_s", "positions_m", "delay_s")
        for axis in axes:
            assert np.array_equal(data[axis], getattr(results[0], axis))
        assert data["sequence"].tolist() == [each.stamp.sequence for each in measurements]
        assert Settings.from_toml(str(data["settings"])).processing == results[0].settings.processing


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (
            ("-o", "x.h5", "--last-stage", "beams"),
            2,
            "the last stage is beams, but an energyscape file holds images",
        ),
        (("--last-stage", "demodulation"), 2, "the last stage is demodulation, but an energyscape file holds images"),
        (
            ("-o", "x.npz"),
            2,
            "-o x.npz is for signals and beams; add --last-stage, or export images with",
        ),
        (("-o", "x.npz", "--last-stage", "beams", "--verify"), 2, "--verify is for images; remove it with -o x.npz"),
        (
            ("-o", "x.npz", "--last-stage", "beams", "--method", "paper"),
            1,
            "but --method 'paper' returns none",
        ),
        (("-o", "x.npz", "--last-stage", "beams", "--sensor", "left"), 1, "left"),
    ],
)
def test_process_command_refuses_stages_that_a_file_cannot_hold(
    recording, tmp_path, monkeypatch, arguments, code, message
):
    monkeypatch.chdir(tmp_path)
    assert message in run("process", recording, *arguments, code=code).stderr
    assert list(tmp_path.iterdir()) == []


def test_recording_of_another_last_stage_has_no_image_to_plot_or_export(tmp_path):
    path = tmp_path / "rec.h5"
    write_recording(path, measurements_of(ending("beams"), 1))
    for command in (("plot", path, "-o", tmp_path / "a.png"), ("export", path, "-o", tmp_path / "a.csv")):
        assert "yields no image" in run(*command, code=1).stderr or "holds images" in run(*command, code=1).stderr
    assert list(tmp_path.iterdir()) == [path]
    run("export", path, "-o", tmp_path / "a.npz", "-q")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as data:
        assert data["beam"].shape[0] == 1


def test_results_of_different_stages_cannot_share_a_file(tmp_path):
    measurement = noise(FINE)
    with Pipeline(FINE, "cpu", predict=False) as pipeline:
        beams, signals = pipeline.beams(measurement), pipeline.signals(measurement)
    with pytest.raises(ArgumentError, match="Beams and MicrophoneSignals cannot share one npz; pass results of one"):
        ertis.export(tmp_path / "a.npz", [beams, signals])
    other = Beams(beams.beam, beams.azimuth_rad, beams.elevation_rad, beams.range_m, beams.settings, Stamp(sensor="b"))
    with pytest.raises(ArgumentError, match="cannot share the axes of one npz; choose one"):
        ertis.export(tmp_path / "a.npz", [beams, other])
    assert list(tmp_path.iterdir()) == []
