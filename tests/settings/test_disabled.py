"""Microphones in ``array.disabled``: no step uses them, and the origin of images does not move."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba import export, figures
from ertis_numba.analysis.compare import compare
from ertis_numba.analysis.health import health
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import load_layout, microphones, received_settings, self_contained
from ertis_numba.pipeline import Pipeline
from ertis_numba.pipeline.verification import measure
from ertis_numba.settings import Array, Settings
from ertis_numba.settings.beamformers import ADAPTIVE_COMBINATIONS
from ertis_numba.simulation import load_scene
from ertis_numba.simulation.render import Simulator
from ertis_numba.storage import open_energyscapes, open_recording
from tests.files import SMALL, line, noise

ROOT = Path(__file__).parents[2]
FAULTY = (3, 8, 11, 12, 21, 26)
SCENE = ROOT / "data" / "synthetic" / "scenes" / "faulty_array.toml"


def run(*words, code=0):
    done = CliRunner().invoke(cli, [str(word) for word in words])
    assert done.exit_code == code, (done.output, done.exception)
    return done


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("faulty") / "rec.h5"
    run("simulate", SCENE, "-o", path, "--quiet")
    return path


def without(settings, *channels):
    return settings.replace(array=settings.array.replace(disabled=channels))


# ---- the array ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("array", [Array(), line(8, 8).array], ids=["named", "written out"])
def test_disabled_microphones_do_not_move_the_array(array):
    """A faulty microphone does not move the sensor."""
    whole, fewer = microphones(array), microphones(array.replace(disabled=(1, 5)))
    assert_array_equal(fewer.positions_m, whole.positions_m)
    assert set(np.flatnonzero(whole.enabled)) - set(np.flatnonzero(fewer.enabled)) == {1, 5}


def test_disabled_microphones_survive_settings_round_trips():
    settings = without(Settings(), 5, 12)
    written = self_contained(settings)
    for read in (written, Settings.from_toml(written.to_toml()), received_settings(written.to_toml(), "a sensor")):
        assert read.array.disabled == (5, 12)
        layout = microphones(read.array)
        assert_array_equal(np.flatnonzero(~layout.enabled), [5, 12])
        assert_array_equal(layout.positions_m, load_layout("eRTIS_v3D1").positions_m)


def test_settings_omit_empty_disabled_list():
    assert "disabled" not in Settings().to_toml()


@pytest.mark.parametrize(
    ("disabled", "message"),
    [
        ((32,), "array.disabled is 32; use a whole number from 0 to 31"),
        ((-1,), "array.disabled\\[0\\] is -1; use a whole number from 0"),
        (tuple(range(32)), "array.disabled disables all 32 microphones; name fewer channels"),
    ],
)
def test_invalid_disabled_channels_are_refused(disabled, message):
    with pytest.raises(ArgumentError, match=message):
        microphones(Array(disabled=disabled))


def test_settings_file_with_only_disabled_keeps_the_array(tmp_path):
    (tmp_path / "s.toml").write_text("[array]\ndisabled = [2]\n")
    known = line(8, 8)
    changed = known.updated_from_file(tmp_path / "s.toml")
    assert changed.array == known.array.replace(disabled=(2,))


# ---- images, exports and figures -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "processing",
    [
        {},
        {"method": "paper"},
        {"wavefront": "spherical"},
        *({"beamformer": beamformer, "weighting": weighting} for beamformer, weighting in ADAPTIVE_COMBINATIONS),
    ],
    ids=lambda changes: "-".join(changes.values()) or "fast",
)
def test_samples_of_disabled_microphones_do_not_change_images(processing):
    """Images are equal for any samples of the disabled microphones."""
    settings = without(SMALL.replace(processing=SMALL.processing.replace(**processing)), 4, 9)
    (measurement,) = noise(settings, count=1)
    other = dataclasses.replace(measurement, data=measurement.data ^ np.uint32(1 << 4 | 1 << 9))
    device = "numpy" if processing.get("method") == "paper" else "cpu"
    with Pipeline(settings, device=device, predict=False) as pipeline:  # an image of noise may exceed its budget
        assert_array_equal(pipeline.process(measurement).amplitude, pipeline.process(other).amplitude)


def test_image_with_disabled_microphones_meets_its_error_budget():
    settings = without(SMALL, 4, 9)
    (measurement,) = noise(settings, count=1)
    with Pipeline(settings) as pipeline:
        assert measure(pipeline.process(measurement), measurement).error_db < settings.accuracy.max_error_db


def test_disabled_microphones_do_not_move_reflectors():
    scene = load_scene(ROOT / "data" / "synthetic" / "reflectors.toml")
    with open_recording(ROOT / "data" / "synthetic" / "reflectors.h5") as recording:
        measurement = recording[0]
    settings = without(measurement.settings, 0, 1, 2, 3)
    image = Pipeline(settings).process(dataclasses.replace(measurement, settings=settings))
    found = compare(image, Simulator(scene).reflectors(), min_level_db=-12.0)
    assert len(found.matched) == 5
    for match in found.matched:
        assert abs(match.range_m) < 0.001


def test_health_ignores_disabled_microphones(recording):
    with open_recording(recording) as given:
        measurement = given[0]
    report = health(dataclasses.replace(measurement, settings=without(measurement.settings, *FAULTY)))
    assert not set(FAULTY) & {each.channel for each in report.channels}
    assert not report.faults


def test_exports_and_figures_omit_disabled_microphones(recording, tmp_path):
    with open_recording(recording) as given:
        measurement = dataclasses.replace(given[0], settings=without(given[0].settings, *FAULTY))
    export(tmp_path / "signals.h5", [measurement])
    xml = next(tmp_path.glob("*.xml")).read_text()
    assert xml.count("<pos ") == 26
    assert 'channel 8"' not in xml
    for draw in (figures.signals, figures.matched_filter):
        draw(measurement)
        with pytest.raises(ArgumentError, match="microphone"):
            draw(measurement, microphone=8)
    figures.array(measurement.settings)


# ---- the command line ----------------------------------------------------------------------------------


def test_process_advice_on_faulty_microphones_works(recording, tmp_path):
    first = tmp_path / "first.h5"
    (reported,) = run("process", recording, "-o", first, "--quiet").stderr.splitlines()
    advice = reported.partition("exclude them with ")[2].partition(",  or")[0].partition(", or see")[0]
    assert advice == "--without 3,8,11,12,21,26"
    second = tmp_path / "second.h5"
    assert run("process", recording, "-o", second, "--quiet", "--strict", *advice.split()).stderr == ""
    with open_energyscapes(second) as images:
        assert images.settings.array.disabled == FAULTY
    (section,) = json.loads(run("info", second, "--json").stdout)["sensors"]
    assert (section["microphones"], section["disabled"]) == (26, [*FAULTY])
    (tmp_path / "s.toml").write_text(f"[array]\ndisabled = {[*FAULTY]}\n")
    third = tmp_path / "third.h5"
    assert run("process", recording, "-o", third, "--quiet", "--settings", tmp_path / "s.toml").stderr == ""
    with open_energyscapes(second) as one, open_energyscapes(third) as other:
        assert_allclose(one[0].amplitude, other[0].amplitude, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ("x", "'x' is not a list of channels; use integers from 0 to 1023, as in 5,12"),
        ("40", "--without is 40; use a whole number from 0 to 31"),
    ],
)
def test_process_without_rejects_invalid_channels(recording, tmp_path, channels, message):
    done = run("process", recording, "-o", tmp_path / "a.h5", "--without", channels, code=2 if channels == "x" else 1)
    assert message in done.stderr


def test_layout_command_prints_a_loadable_layout(tmp_path):
    listed = json.loads(run("reference", "layouts", "--json").stdout)["layouts"]
    assert {"name": "eRTIS_v3D1", "microphones": 32, "word_bits": 32} in listed
    assert "eRTIS_v3D1" in run("reference", "layouts").stdout
    path = tmp_path / "mine.toml"
    path.write_text(run("reference", "layouts", "eRTIS_v2").stdout)
    assert_array_equal(load_layout(path).positions_m, load_layout("eRTIS_v2").positions_m)
    assert (
        "layout 'eRTIS_v9' is unknown (did you mean 'eRTIS_v2'?)"
        in run("reference", "layouts", "eRTIS_v9", code=1).stderr
    )
