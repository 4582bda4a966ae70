"""``ertis simulate`` renders a scene file into a recording."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba.simulation import Point, Scene
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.render import Simulator
from ertis_numba.storage import open_recording
from tests.scenes import EAR, SENSOR, scene_of

SCENE = scene_of(Point(azimuth_deg=25, elevation_deg=-10, range_m=0.7, strength_db=-15))
PAIR = SCENE.replace(
    sensors=(SENSOR.replace(name="left"), EAR.replace(name="right", position_m=(0.1, -0.4, 0.0), yaw_deg=30))
)


@pytest.fixture
def scene_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.to_toml(), encoding="utf-8")
    return path


def simulate(*arguments):
    return CliRunner().invoke(cli, ["simulate", *map(str, arguments)])


def test_simulate_writes_the_rendered_samples(scene_file, tmp_path):
    target = tmp_path / "out.h5"
    result = simulate(scene_file, "-o", target, "--count", 3, "--seed", 11, "--json", "--quiet")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert (report["output"], report["measurements"], report["seed"]) == (str(target), 3, 11)
    [[row]] = [entry["reflectors"] for entry in report["sensors"]]
    assert row["name"] == "points[0]"
    assert (row["azimuth_deg"], row["elevation_deg"], row["range_m"], row["level_db"]) == (25.0, -10.0, 0.7, 0.0)
    simulator = Simulator(SCENE.replace(seed=11, count=3))
    with open_recording(target) as recording:
        assert len(recording) == 3
        for index, measurement in enumerate(recording):
            wanted = simulator.render(index)
            assert_array_equal(measurement.data, wanted.data)
            assert measurement.stamp == wanted.stamp
        truth = recording.truth
    decided = Scene.from_toml(truth.scene)
    assert decided.replace(effects={}) == simulator.scene
    assert Simulator(decided).plan.active == simulator.plan.active  # The recording stores the effect decisions.
    assert truth.seed == 11
    assert [[reflector.name for reflector in row] for row in truth.reflectors] == [["points[0]"]] * 3


def test_simulate_writes_beside_the_scene_and_overwrites_with_force(scene_file):
    assert simulate(scene_file).exit_code == 0
    assert scene_file.with_suffix(".h5").exists()
    refused = simulate(scene_file)
    assert refused.exit_code == 1
    assert "scene.h5 exists; choose another name, or replace the file (--force)" in refused.stderr
    assert simulate(scene_file, "--force").exit_code == 0


def test_simulate_records_all_sensors_or_one(tmp_path):
    path = tmp_path / "pair.toml"
    path.write_text(PAIR.to_toml(), encoding="utf-8")
    assert simulate(path, "--count", 2, "--quiet").exit_code == 0
    for name in ("left", "right"):
        with open_recording(path.with_suffix(".h5"), sensor=name) as recording:
            assert_array_equal(recording[1].data, Simulator(PAIR.replace(count=2), sensor=name).render(1).data)
    with open_recording(path.with_suffix(".h5"), sensor="right") as recording:
        assert_allclose(recording.translation_m, (0.1, -0.4, 0.0))
        assert_allclose(recording.rotation_xyzw, (0, 0, np.sin(np.radians(15)), np.cos(np.radians(15))), atol=1e-12)
    one = tmp_path / "one.h5"
    assert simulate(path, "-o", one, "--sensor", "right", "--quiet").exit_code == 0
    with open_recording(one) as recording:
        assert recording[0].stamp.sensor == "right"


def test_ground_truth_follows_moving_objects(tmp_path):
    point = Point(position_m=(0.5, 0.0, 0.0), velocity_m_s=(1.0, 0.0, 0.0))
    path = tmp_path / "moving.toml"
    path.write_text(scene_of(point, sensor=EAR, rate_hz=10.0, count=3).to_toml(), encoding="utf-8")
    assert simulate(path, "--quiet").exit_code == 0
    with open_recording(path.with_suffix(".h5")) as recording:
        reflectors = [row[0] for row in recording.truth.reflectors]
    assert_allclose([reflector.range_m for reflector in reflectors], [0.5, 0.6, 0.7])
    assert_allclose([reflector.velocity_m_s for reflector in reflectors], [(1.0, 0.0, 0.0)] * 3)


def test_simulate_records_scenes_without_reflectors(tmp_path):
    path = tmp_path / "empty.toml"
    path.write_text(SCENE.replace(points=()).to_toml(), encoding="utf-8")
    result = simulate(path, "--json", "--quiet")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["sensors"] == [{"sensor": "sensor", "reflectors": []}]


def test_simulate_explains_effects_as_json(scene_file):
    result = simulate(scene_file, "--explain", "--json", "--quiet")
    assert result.exit_code == 0
    effects = json.loads(result.stdout)["effects"]
    assert [effect["name"] for effect in effects] == list(EFFECTS)
    for effect in effects:
        assert {"name", "on", "reason", "estimate_db", "cost_ms"} <= set(effect)
        assert effect["reason"]
        assert effect["on"] or effect["cost_ms"] == 0
    costs = {effect["name"]: effect["cost_ms"] for effect in effects}
    assert costs["modulation"] > 0
    assert costs["propagation"] > 0


def test_simulate_explains_effects_in_a_table(scene_file):
    result = simulate(scene_file, "--explain", "--quiet")
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    for name in EFFECTS:
        assert any(re.match(rf"{name} +(on|off)\b", line) for line in lines)


def test_tolerance_selects_the_effects(scene_file):
    def active(*arguments):
        report = json.loads(simulate(scene_file, "--force", "--explain", "--json", "--quiet", *arguments).stdout)
        return {effect["name"] for effect in report["effects"] if effect["on"]}

    assert "absorption" in active()
    assert "absorption" not in active("--tolerance-db", 30)


@pytest.mark.parametrize(
    ("text", "arguments", "code", "message"),
    [
        (None, (), 1, r"scene\.toml: .*; choose a scene file \(TOML\)"),
        (b"\xe9", (), 1, r"not text in UTF-8 \(byte 0xe9 at position 0\)"),
        ("sede = 1", (), 1, r"scene\.toml.*unknown key `sede`; correct it or remove it"),
        ("[[sensors]]\narray.layout = 'eRTIS'", (), 1, "layout 'eRTIS' is unknown"),
        ("seed = 1", ("--sensor", "left"), 1, "sensor 'left' is unknown; known are sensor"),
        ("seed = 1", ("--tolerance-db", "-1"), 2, "--tolerance-db is -1; use a number from 0 to 60"),
        ("seed = 1", ("--count", "0"), 2, "--count"),
        ("seed = 1", ("--seed", "-1"), 2, "--seed"),
    ],
)
def test_simulate_refuses_invalid_input(tmp_path, text, arguments, code, message):
    path = tmp_path / "scene.toml"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    result = simulate(path, *arguments)
    assert result.exit_code == code
    assert re.search(message, result.stderr)
    assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == ([path] if text is not None else [])


def test_simulate_reports_overloaded_modulators(tmp_path):
    path = tmp_path / "loud.toml"
    path.write_text(SCENE.replace(points=(SCENE.points[0].replace(strength_db=10.0),)).to_toml(), encoding="utf-8")
    result = simulate(path)
    assert result.exit_code == 0
    assert "of full scale, but modulators follow only up to 0.6; lower emitter.level_db" in result.stderr


def test_simulate_refuses_devices_and_links_as_output(scene_file, tmp_path):
    link = tmp_path / "link.h5"
    link.symlink_to(tmp_path / "nowhere.h5")
    for target in ("/dev/null", link):
        refused = simulate(scene_file, "-o", target, "--force")
        assert refused.exit_code == 1
        assert "is a link or a device; choose the name of a file" in refused.stderr
    assert link.is_symlink()
