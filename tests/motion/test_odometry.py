"""``ertis odometry``: trajectories from recordings of one or several sensors, and bad input."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.settings import Processing
from ertis_numba.simulation import Electronics, Emitter, Platform, Point, Scene, Sensor
from ertis_numba.storage import open_recording, write_recording
from tests.pages import commands_in, page, run_here

PLATFORM = Platform(waypoints=((0.0, 0.0, 0.0, 0.0, 0.0), (0.2, 0.12, 0.04, 0.0, 6.0)))
COUNT = 3


SENSORS = ("front", 0.2, 0.0), ("back", -0.2, 180.0)


def moving_scene(count=28, given=SENSORS):
    """Return a scene in which a platform with sensors passes reflectors all around it."""
    draws = np.random.default_rng(5)
    angle_rad, range_m = draws.uniform(-math.pi, math.pi, count), draws.uniform(1.0, 2.2, count)
    points = tuple(
        Point(position_m=(r * math.cos(angle), r * math.sin(angle), 0.4), strength_db=strength)
        for angle, r, strength in zip(
            angle_rad.tolist(), range_m.tolist(), draws.uniform(-12, -4, count).tolist(), strict=True
        )
    )
    sensors = tuple(
        Sensor(
            name=name,
            position_m=(x_m, 0.0, 0.4),
            yaw_deg=yaw_deg,
            processing=Processing(range_m=(0.4, 2.5), directions="90"),
            emitter=Emitter(level_db=-24.0, diameter_m=0.012),
            electronics=Electronics(noise_dbfs=-60.0),
        )
        for name, x_m, yaw_deg in given
    )
    return Scene(seed=3, platform=PLATFORM, sensors=sensors, points=points, rate_hz=10.0, count=COUNT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Recordings of a moving platform: of both sensors, of each one, and with faults."""
    place = tmp_path_factory.mktemp("odometry")
    scene = moving_scene()
    mountings = {sensor.name: (sensor.position_m, sensor.quaternion()) for sensor in scene.sensors}
    measurements = []
    for sensor in scene.sensors:
        simulator = ertis.Simulator(scene, sensor=sensor.name)
        measurements += [simulator.render(index) for index in range(COUNT)]
    write_recording(place / "both.h5", measurements, mounting=mountings)
    write_recording(place / "unmounted.h5", measurements)
    for name, start in (("front", 0), ("back", COUNT)):
        write_recording(place / f"{name}.h5", measurements[start : start + COUNT], mounting={name: mountings[name]})
    late = [
        replace(each, stamp=replace(each.stamp, timestamp_ns=each.stamp.timestamp_ns + 10**10))
        for each in measurements[COUNT:]
    ]
    write_recording(place / "late.h5", late, mounting={"back": mountings["back"]})
    write_recording(place / "single.h5", measurements[:1], mounting={"front": mountings["front"]})
    timeless = [replace(each, stamp=replace(each.stamp, timestamp_ns=0)) for each in measurements[:COUNT]]
    write_recording(place / "timeless.h5", timeless, mounting={"front": mountings["front"]})
    slow = [
        replace(each, stamp=replace(each.stamp, timestamp_ns=each.stamp.timestamp_ns * 20))
        for each in measurements[:COUNT]
    ]
    passive = [replace(each, stamp=replace(each.stamp, behaviour="passive")) for each in measurements[:COUNT]]
    # The front sensor of a platform that emits nothing else: echoes of other calls would be mirrored.
    simulator = ertis.Simulator(moving_scene(60, SENSORS[:1]))
    alone = [simulator.render(index) for index in range(COUNT)]
    write_recording(place / "alone.h5", alone, mounting={"front": mountings["front"]})
    write_recording(place / "passive.h5", passive, mounting={"front": mountings["front"]})
    write_recording(place / "mixed.h5", [alone[0], passive[1], alone[2]], mounting={"front": mountings["front"]})
    silent = [replace(each, stamp=replace(each.stamp, behaviour="passive")) for each in measurements[COUNT:]]
    write_recording(place / "silent_back.h5", [*alone, *silent], mounting=mountings)
    other_chain = [
        replace(
            each,
            stamp=replace(each.stamp, sensor="other", behaviour="passive", timestamp_ns=each.stamp.timestamp_ns * 8),
        )
        for each in measurements[:COUNT]
    ]
    write_recording(place / "other_chain.h5", other_chain, mounting={"other": mountings["front"]})
    write_recording(place / "slow.h5", slow, mounting={"front": mountings["front"]})
    return place


def run(*arguments):
    done = CliRunner().invoke(cli, ["odometry", *(str(each) for each in arguments)])
    return done.exit_code, done.stdout, done.stderr


@pytest.mark.parametrize("names", [["both.h5"], ["front.h5", "back.h5"]], ids=["one file", "two files"])
def test_odometry_command_writes_the_trajectory_of_the_platform(folder, tmp_path, names):
    target = tmp_path / "path.tum"
    code, stdout, stderr = run(*(folder / name for name in names), "-o", target, "--json")
    assert code == 0, stderr
    report = json.loads(stdout)
    assert report.pop("length_m") == pytest.approx(math.hypot(0.12, 0.04), abs=2e-3)
    assert report.pop("duration_s") == pytest.approx(0.2, abs=1e-5)
    assert report == {
        "output": str(target),
        "sensors": ["front", "back"],
        "poses": COUNT,
        "left_out": 0,
        "measured": 1.0,
        "uncertain": 0,
    }
    assert f"{target}: 3 poses, 0.13 m in 0.2 s, 100% measured" in stderr
    path = ertis.read_trajectory(target)
    true = PLATFORM.trajectory(np.arange(COUNT) / 10)
    np.testing.assert_allclose(path.position_m, true.position_m, atol=2e-3)
    np.testing.assert_allclose(path.rotation_xyzw, true.rotation_xyzw, atol=3e-3)
    with open_recording(folder / "both.h5", sensor="front") as recording:
        stamps_ns = [stamp.timestamp_ns for stamp in recording.stamps()]
    np.testing.assert_allclose(path.time_ns, stamps_ns, atol=1000)


def test_odometry_command_leaves_out_pulses_without_a_call(folder, tmp_path):
    code, stdout, stderr = run(folder / "mixed.h5", "--alone", "-o", tmp_path / "path.tum", "--json")
    assert code == 0, stderr
    assert json.loads(stdout)["left_out"] == 1
    assert "note: 1 of 3 pulses left out, because no sensor emitted its call" in stderr
    path = ertis.read_trajectory(tmp_path / "path.tum")
    np.testing.assert_allclose(path.position_m, PLATFORM.trajectory(np.array([0.0, 0.2])).position_m, atol=4e-3)


def test_odometry_command_leaves_out_silent_sensors(folder, tmp_path):
    for name in ("silent_back", "alone"):
        code, _, stderr = run(folder / f"{name}.h5", "--alone", "-o", tmp_path / f"{name}.tum")
        assert code == 0, stderr
    assert (tmp_path / "silent_back.tum").read_text() == (tmp_path / "alone.tum").read_text()


def test_odometry_command_of_a_single_sensor_names_the_option_for_one_that_emits_alone(folder, tmp_path):
    code, _, stderr = run(folder / "alone.h5", "-o", tmp_path / "alone.tum")
    assert code == 1
    assert "use 'ertis odometry --alone' if no other sensor emits" in stderr
    assert not (tmp_path / "alone.tum").exists()


def test_odometry_command_names_its_output_after_the_recording(folder, tmp_path):
    recording = tmp_path / "both.h5"
    recording.symlink_to(folder / "both.h5")
    code, stdout, stderr = run(recording, "--quiet")
    assert (code, stdout, stderr) == (0, "", "")
    code, _, stderr = run(recording)
    assert (code, "both.odometry.tum exists; choose another name" in stderr) == (1, True), stderr


def test_odometry_command_takes_mountings_from_a_file(folder, tmp_path):
    unmounted = folder / "unmounted.h5"
    arguments = (unmounted, "--mounting", folder / "both.h5", "-o", tmp_path / "path.tum", "--json")
    code, stdout, stderr = run(*arguments)
    assert code == 0, stderr
    assert json.loads(stdout)["measured"] == 1.0


@pytest.mark.parametrize(
    ("names", "status", "message"),
    [
        (["unmounted.h5"], 1, "the mounting of sensor 'front' is unknown; add its mounting with --mounting FILE"),
        (["both.h5", "--mounting", "front.h5"], 1, "front.h5 does not contain sensor 'back'; add its mounting, or"),
        (["single.h5"], 1, "single.h5 contains one pulse; at least two"),
        (["front.h5", "both.h5"], 2, "contain the same sensor 'front'"),
        (["timeless.h5"], 1, "timeless.h5 contains several pulses with the same timestamp"),
        (["front.h5", "late.h5"], 1, "no pulse has measurements of two sensors: front has pulses 0 to 2 from 0.000 s"),
        (
            ["front.h5", "other_chain.h5"],
            1,
            "of SYNC count 1 are 0.7 s apart; use recordings of one SYNC chain, whose",
        ),
        (["slow.h5"], 1, "slow.h5: no two successive pulses have enough echoes in common, at most a second apart"),
        (["front.h5"], 1, "front.h5: no step determines the motion, because standing still, mirrored motion or the"),
        (["passive.h5"], 1, "passive.h5: all measurements are passive and have no echoes; use recordings of emitted"),
        (["both.h5", "--preset", "none"], 2, "preset 'none' is unknown"),
    ],
)
def test_odometry_command_explains_what_it_cannot_use(folder, tmp_path, names, status, message):
    target = tmp_path / "path.tum"
    arguments = [folder / name if name.endswith(".h5") else name for name in names]
    code, _, stderr = run(*arguments, "-o", target)
    assert (code, message in stderr) == (status, True), stderr
    assert len([line for line in stderr.splitlines() if line.startswith("ertis: error")]) == 1
    assert not target.exists()


def test_odometry_command_refuses_settings_without_images(folder, tmp_path):
    (tmp_path / "beams.toml").write_text('[processing]\nlast_stage = "beams"\n')
    code, _, stderr = run(folder / "both.h5", "--settings", tmp_path / "beams.toml", "-o", tmp_path / "path.tum")
    assert code == 2
    assert 'beams, but echoes come from images; set last_stage = "envelope" in --settings FILE' in stderr


def test_odometry_command_refuses_another_format_at_once(folder, tmp_path):
    code, _, stderr = run(folder / "both.h5", "-o", tmp_path / "path.csv")
    assert (code, stderr.count("\n")) == (1, 1)
    assert "path.csv ends in .csv, but poses are written as TUM text; choose a name that ends in .tum or .txt" in stderr


def test_odometry_command_notes_steps_without_matches(folder, tmp_path):
    """The platform stands for two seconds without pulses before it drives on."""
    given, mounting = [], {}
    for name in ("front", "back"):
        with open_recording(folder / f"{name}.h5") as recording:
            given += [recording[index] for index in range(COUNT)]
            mounting[name] = recording.translation_m.tolist(), recording.rotation_xyzw.tolist()
        stamp = replace(given[-1].stamp, timestamp_ns=given[-1].stamp.timestamp_ns + 2 * 10**9)
        given[-1] = replace(given[-1], stamp=stamp)
    write_recording(tmp_path / "rec.h5", given, mounting=mounting)
    code, stdout, stderr = run(tmp_path / "rec.h5", "--json")
    assert code == 0, stderr
    assert (
        "note: 1 of 2 steps follow a pause of more than a second and assume that the last velocity continued" in stderr
    )
    assert json.loads(stdout)["measured"] == 0.5


def test_commands_of_the_motion_page_run(tmp_path):
    """Two pulses are enough, because all of them take a minute."""
    for command in commands_in(page("motion")):
        run_here(tmp_path, command)
        if command.startswith("example"):
            scene = tmp_path / "moving_platform.toml"
            scene.write_text(scene.read_text("utf-8").replace("count = 6", "count = 2"), "utf-8")
    path = ertis.read_trajectory(tmp_path / "PATH.tum")
    with open_recording(tmp_path / "moving_platform.h5", sensor="front") as recording:
        true_m = np.diff(recording.trajectory.position_m, axis=0)
    np.testing.assert_allclose(np.diff(path.position_m, axis=0), true_m, atol=0.01)  # Both begin at a yaw of 0.
    data = scipy.io.loadmat(tmp_path / "SET.mat")
    np.testing.assert_allclose(data["odom_delta"], data["gt_delta"], atol=0.02)
    assert data["reflectors"]["position"][0, 0].shape == (8, 3)


def test_path_of_odometry_serves_maps_and_recordings(folder, tmp_path, monkeypatch):
    """Sensors of a pulse measure in succession, so the path begins after some measurements and ends before others."""
    monkeypatch.chdir(tmp_path)
    drive = str(folder / "both.h5")
    for command in (
        ["odometry", drive, "-o", "path.tum"],
        ["import", "poses", drive, "path.tum", "-o", "posed.h5", "--force"],
        ["map", drive, "--poses", "path.tum", "-o", "place.h5"],
    ):
        done = CliRunner().invoke(cli, command)
        assert done.exit_code == 0, done.stderr
    assert ertis.read_map("place.h5").n_groups == 3
    with ertis.open_recording("posed.h5", sensor="back") as recording:
        assert recording.trajectory.source == "file"
        assert len(recording.trajectory) == 3
