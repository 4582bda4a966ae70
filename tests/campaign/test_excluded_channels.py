"""Channels that ``--without`` excludes, of all sensors or of one."""

import dataclasses
import json

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from numpy.testing import assert_array_equal

from ertis_numba.base.errors import ArgumentError
from ertis_numba.campaign import CampaignOptions
from ertis_numba.network.processing import ProcessingOptions
from ertis_numba.pipeline import Pipeline
from ertis_numba.sensor_check import check_recording
from ertis_numba.settings import ExcludedChannels, Settings
from ertis_numba.storage import open_energyscapes, open_recording, write_recording
from tests.campaigns import run_here
from tests.files import SMALL, noise

pytestmark = pytest.mark.usefixtures("sound_unchecked")

PLACE = {"left": ((0.0, 0.1, 0.0), (0.0, 0.0, 0.0, 1.0)), "right": ((0.0, -0.1, 0.0), (0.0, 0.0, 0.0, 1.0))}


def run(*words, code=0):
    done = CliRunner().invoke(cli, [str(word) for word in words])
    assert done.exit_code == code, (done.output, done.exception)
    return done


def of_sensor(name, count=1, seed=1):
    return [
        dataclasses.replace(each, stamp=dataclasses.replace(each.stamp, sensor=name))
        for each in noise(SMALL, count=count, seed=seed)
    ]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    measurements = [*of_sensor("left"), *of_sensor("right", seed=2)]
    return write_recording(tmp_path_factory.mktemp("pair") / "pair.h5", measurements, mounting=PLACE)


def disabled(path):
    found = {}
    for name in ("left", "right"):
        with open_energyscapes(path, sensor=name) as images:
            found[name] = images.settings.array.disabled
    return found


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (["3,5"], {"left": (3, 5), "right": (3, 5)}),
        (["right:7"], {"left": None, "right": (7,)}),
        (["right:7", "left:1,2", "30"], {"left": (1, 2, 30), "right": (7, 30)}),
        (["right:7", "right:9,7"], {"left": None, "right": (7, 9)}),
    ],
)
def test_process_excludes_channels_of_all_sensors_or_of_one(recording, tmp_path, given, wanted):
    options = [word for each in given for word in ("--without", each)]
    run("process", recording, "-o", tmp_path / "a.h5", "--quiet", *options)
    assert disabled(tmp_path / "a.h5") == wanted
    with (
        open_recording(recording, sensor="right") as recorded,
        open_energyscapes(tmp_path / "a.h5", sensor="right") as images,
    ):
        settings = recorded.settings.replace(array=recorded.settings.array.replace(disabled=wanted["right"]))
        measurement = dataclasses.replace(recorded[0], settings=settings)
        with Pipeline(images.settings) as pipeline:
            image = pipeline.process(dataclasses.replace(measurement, settings=pipeline.settings))
        assert_array_equal(image.amplitude, images[0].amplitude)


def test_several_recordings_exclude_channels_of_the_sensor_that_some_contain(recording, tmp_path, monkeypatch):
    alone = write_recording(tmp_path / "alone.h5", of_sensor("left"))
    wanted = CampaignOptions(without=ExcludedChannels(of_sensor={"right": (7,)}))
    run_here(monkeypatch, [recording, alone], tmp_path / "out", wanted)
    assert disabled(tmp_path / "out" / "pair.energy.h5") == {"left": None, "right": (7,)}
    unknown = CampaignOptions(without=ExcludedChannels(of_sensor={"rihgt": (7,)}))
    with pytest.raises(ArgumentError, match=r"sensor 'rihgt' is unknown.*known are left, right"):
        run_here(monkeypatch, [recording, alone], tmp_path / "other", unknown)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("line", ["process", "fuse", "acoustic", "process --sensor left"])
def test_unknown_sensors_are_refused_with_those_of_the_recording(recording, tmp_path, line):
    done = run(*line.split(), recording, "-o", tmp_path / "a.h5", "--without", "labB:7", code=1)
    (line,) = [each for each in done.stderr.splitlines() if "error" in each]
    assert "sensor 'labB' is unknown; known are left, right" in line
    assert not (tmp_path / "a.h5").exists()


@pytest.mark.parametrize("text", [":7", "a b:7", "left:", "left:x", "left:3,right:4", "left:1024"])
def test_invalid_lists_are_refused_with_an_example(text):
    done = run("process", "r.h5", "--without", text, code=2)
    assert f"'{text}' is not a list of channels" in done.stderr
    assert "left:5,12" in done.stderr


@pytest.mark.parametrize(
    ("value", "wanted"),
    [('"3,5"', {"left": (3, 5), "right": (3, 5)}), ('["left:1", "2"]', {"left": (1, 2), "right": (2,)})],
)
def test_a_configuration_sets_one_list_or_several(recording, tmp_path, value, wanted):
    (tmp_path / "c.toml").write_text(f"[process]\nwithout = {value}\n")
    run("--config", tmp_path / "c.toml", "process", recording, "-o", tmp_path / "a.h5", "--quiet")
    assert disabled(tmp_path / "a.h5") == wanted


def test_check_excludes_channels_of_one_sensor_and_names_it_in_remedies(recording):
    checked = check_recording(recording, without=ExcludedChannels(of_sensor={"right": (4,)}))
    assert {each.sensor: each.n_microphones for each in checked.sensors} == {"left": 32, "right": 31}
    done = run("sensors", "check", recording, "--without", "right:4", "--json", code=1)
    assert [each["microphones"] for each in json.loads(done.stdout)["sensors"]] == [32, 31]
    with pytest.raises(ArgumentError, match="known are left, right"):
        check_recording(recording, without=ExcludedChannels(of_sensor={"labB": (4,)}))


def test_serve_applies_channels_of_one_sensor():
    options = ProcessingOptions(without=ExcludedChannels((2,), {"left": (7,)}))
    assert options.applied(Settings(), "left").array.disabled == (2, 7)
    assert options.applied(Settings(), "right").array.disabled == (2,)


@pytest.mark.parametrize(
    ("given", "stated"),
    [
        ({"of_all": (-1,)}, r"of_all is -1; .* from 0 to 1023"),
        ({"of_sensor": {"left": (1024,)}}, r"of_sensor\['left'\] is 1024"),
        ({"of_sensor": {"a:b": (1,)}}, "cannot name a group"),
    ],
)
def test_invalid_channels_and_names_are_refused(given, stated):
    with pytest.raises(ArgumentError, match=stated):
        ExcludedChannels(**given)
