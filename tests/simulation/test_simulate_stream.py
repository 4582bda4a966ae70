"""Long simulations: required disk space, memory use and streamed ground truth."""

import re
import shutil
import time
from collections import namedtuple

import pytest
from click.testing import CliRunner
from ertis_cli import simulate as command
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Reflector
from ertis_numba.geometry import load_layout, shipped_layouts
from ertis_numba.simulation import Box, Point, Scene, Tone
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.engine import Engine
from ertis_numba.storage import GroundTruthLog, open_recording, write_recording
from tests.files import noise
from tests.scenes import SENSOR, scene_of

MOVING = scene_of(Point(range_m=0.6, velocity_m_s=(0.1, 0.0, 0.0)))


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(MOVING.to_toml(), encoding="utf-8")
    return path


def simulate(*arguments):
    return CliRunner().invoke(cli, ["simulate", *map(str, arguments)])


def test_simulation_without_free_space_is_refused_before_computing(path, monkeypatch):
    monkeypatch.setattr("ertis_numba.simulation.effect_plan.make_plan", lambda _: pytest.fail("a plan was made"))
    began_s = time.process_time()
    refused = simulate(path, "--count", 10**9)
    assert time.process_time() - began_s < 20
    assert refused.exit_code == 1
    assert re.search(
        r"has [\d.]+ MB free, but [\d.]+ MB are needed for 1000000000 measurements of 1 sensor, .*; free some",
        refused.stderr,
    )
    assert not list(path.parent.glob("scene.h5*"))


def test_ground_truth_is_part_of_the_required_space(path, monkeypatch):
    usage = namedtuple("usage", "total used free")  # noqa: PYI024  shutil uses such a tuple
    words = 2 * 40_000
    free = 10**7 + words
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 0, free))
    monkeypatch.setattr(command, "_REFLECTOR_BYTES", 10**7)
    refused = simulate(path, "--count", 1)
    assert refused.exit_code == 1
    assert "for 1 measurement of 1 sensor" in refused.stderr


def test_ground_truth_is_computed_per_measurement(path, monkeypatch):
    done = []
    render, reflectors = Engine.render, Engine.reflectors
    monkeypatch.setattr(Engine, "render", lambda self, index=0: done.append(("words", index)) or render(self, index))
    monkeypatch.setattr(
        Engine, "reflectors", lambda self, index=0: done.append(("truth", index)) or reflectors(self, index)
    )
    assert simulate(path, "--count", 4, "--quiet").exit_code == 0
    reported = [each for each in done if each[1] > 0]
    assert reported == [(kind, index) for index in (1, 2, 3) for kind in ("truth", "words")]


def test_interrupted_simulation_leaves_no_file(path, monkeypatch):
    def interrupt(self, index=0):
        if index == 2:
            raise KeyboardInterrupt
        return render(self, index)

    render = Engine.render
    monkeypatch.setattr(Engine, "render", interrupt)
    assert simulate(path, "--count", 4).exit_code != 0
    assert [each.name for each in path.parent.iterdir()] == ["scene.toml"]


def test_ground_truth_log_of_several_blocks_is_read_back(tmp_path, monkeypatch):
    monkeypatch.setattr("ertis_numba.storage.truth._BLOCK_ROWS", 2)
    rows = [
        tuple(
            Reflector(
                name=f"points[{k}]",
                azimuth_deg=10.0 * k,
                elevation_deg=-1.0,
                range_m=1.0 + 0.1 * index,
                level_db=-3.0 * k,
                velocity_m_s=(0.0, 1.0, float(index)),
            )
            for k in range(index)
        )
        for index in range(3)
    ]
    with GroundTruthLog("", 5, left_out=("doppler", "walls"), folder=tmp_path) as log:
        for row in rows:
            log.append(row)
        path = write_recording(tmp_path / "rec.h5", noise(), truth={"eRTIS-7": log})
    with open_recording(path) as recording:
        truth = recording.truth
    assert [[each.name for each in row] for row in truth.reflectors] == [[each.name for each in row] for row in rows]
    assert truth.reflectors[2][1].range_m == 1.2
    assert truth.reflectors[2][1].velocity_m_s == (0.0, 1.0, 2.0)
    assert truth.left_out == ("doppler", "walls")


def test_ground_truth_log_names_the_unwritable_folder(tmp_path):
    with pytest.raises(DataError, match=r"gone: a temporary file cannot be written \(No such file or directory\); "):
        GroundTruthLog("", 5, folder=tmp_path / "gone")


def test_shipped_layout_is_read_once(monkeypatch):
    load_layout("eRTIS_v3D1")
    monkeypatch.setattr(shipped_layouts.resources, "files", lambda _: pytest.fail("the layout was read again"))
    layout = load_layout("eRTIS_v3D1")
    layout.positions_m[:] = 0.0  # Each caller has its own copy.
    assert load_layout("eRTIS_v3D1").positions_m.any()


ROOM = Box(position_m=(0.0, 0.0, 0.0), size_m=(6.0, 6.0, 3.0))


def points(count):
    return tuple(Point(position_m=(1 + 1e-4 * k, 0.0, 0.0)) for k in range(count))


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (
            lambda: Scene(sensors=(SENSOR,), points=points(20), boxes=(ROOM,), max_reflections=4),
            r"at least 25780 sound paths to one sensor; the limit is 20000\. Lower",
        ),
        (lambda: Scene(sensors=(SENSOR,), points=points(20_001)), r"at least 20001 sound paths .*; the limit is 20000"),
        (
            lambda: Scene(sensors=(SENSOR,), points=points(1), boxes=(ROOM,) * 31, max_reflections=3),
            r"scene has 6400446 mirror points, from 186 walls \(6 per box\), 1 targets and max_reflections 3; ",
        ),
    ],
)
def test_scene_exceeding_the_memory_is_refused(scene, message):
    with pytest.raises(ArgumentError, match=message):
        make_plan(scene())


def test_measurement_exceeding_the_memory_is_refused(monkeypatch):
    monkeypatch.setattr("ertis_numba.simulation.scene_size_limits.MAX_AMPLITUDES", 100)
    message = (
        r"scene has 1 sound paths to 3 microphones at \d+ frequencies, in total \d+ amplitudes; the limit is 100\."
    )
    with pytest.raises(ArgumentError, match=message):
        Engine(scene_of(Point(range_m=0.6)), SENSOR, frozenset({"propagation"})).render()


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"points": (Point(position_m=(0.0, 0.0, 0.0)),)}, r"points\[0\]"),
        ({"tones": (Tone(frequency_hz=4e4, position_m=(0.0, 0.013, 0.01)),)}, r"tones\[0\]"),
    ],
)
def test_objects_on_their_sensor_are_noted(changes, name):
    notes = make_plan(Scene(sensors=(SENSOR,), **changes)).notes
    assert re.match(rf"{name} is [\d.]+ mm from an emitter or a microphone of sensor at 0 s", notes[0])
    assert make_plan(scene_of(Point(range_m=0.6))).notes == ()


def test_objects_near_an_emitter_beside_the_array_are_noted():
    beside = SENSOR.replace(emitter=SENSOR.emitter.replace(position_m=(0.0, 0.2, 0.0)))
    near = make_plan(Scene(sensors=(beside,), points=(Point(position_m=(0.005, 0.2, 0.0)),))).notes
    assert re.match(r"points\[0\] is 5 mm from an emitter", near[0])
    centre = make_plan(Scene(sensors=(beside,), points=(Point(position_m=(0.0, 0.1, 0.0)),))).notes
    assert centre == ()
