"""`ertis map`: maps of a simulated platform, poses from a file or a recording, and input that is refused."""

import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba.campaign import find_recordings
from ertis_numba.settings import Processing
from ertis_numba.simulation import Electronics, Emitter, Point, Scene, Sensor
from ertis_numba.storage import add_poses, write_recording
from tests.pages import commands_in, page, python_in, run_code_here, run_here

POST_M = (1.4, 0.3)
UNTURNED = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording of two sensors in front of a post, one recording per sensor, and poses."""
    made = tmp_path_factory.mktemp("map")
    sensors = tuple(
        Sensor(
            name=name,
            position_m=(0.1, left_m, 0.4),
            processing=Processing(range_m=(0.4, 2.2), directions="90"),
            emitter=Emitter(level_db=-24.0, diameter_m=0.012),
            electronics=Electronics(noise_dbfs=-60.0),
        )
        for name, left_m in (("left", 0.15), ("right", -0.15))
    )
    scene = Scene(
        seed=6, rate_hz=10.0, count=3, sensors=sensors, points=(Point(position_m=(*POST_M, 0.4), strength_db=0.0),)
    )
    mounting = {sensor.name: (sensor.position_m, sensor.quaternion().tolist()) for sensor in sensors}
    recorded = {
        sensor.name: [ertis.render(scene, number, sensor=sensor.name) for number in range(3)] for sensor in sensors
    }
    write_recording(made / "both.h5", [each for several in recorded.values() for each in several], mounting=mounting)
    for name, several in recorded.items():
        write_recording(made / f"{name}.h5", several, mounting={name: mounting[name]})
    passive = [replace(each, stamp=replace(each.stamp, behaviour="passive")) for each in recorded["left"]]
    write_recording(made / "passive.h5", passive, mounting={"left": mounting["left"]})
    mixed = [recorded["left"][0], passive[1], recorded["left"][2]]
    write_recording(made / "mixed.h5", mixed, mounting={"left": mounting["left"]})
    ertis.write_tum(made / "poses.tum", poses())
    return made


def poses(*, start_ns=0, x_m=10.0):
    return ertis.Trajectory(start_ns + np.array([0, 10**9]), [[x_m, 0.0, 0.0]] * 2, [UNTURNED] * 2)


def run(folder, line, *, code=0):
    arguments = [str(folder / each) if re.search(r"\.(h5|tum|txt|pgm|ply)$", each) else each for each in line.split()]
    done = CliRunner().invoke(cli, ["map", *arguments])
    assert done.exit_code == code, done.output
    return done


def other_notes(done):
    """Notes of a command except two: either of two sensors before one post may be silent, and heights are assumed."""
    usual = "no echo proves", "all directions have elevation 0°"
    return [line for line in done.stderr.splitlines() if "note" in line and not any(text in line for text in usual)]


def test_map_of_a_recording_shows_the_post_in_the_world(folder):
    done = run(folder, "both.h5 --poses poses.tum --json -o first.h5")
    report = json.loads(done.stdout)
    assert (report["pulses"], report["left_out"], report["sensors"]) == (3, 0, ["left", "right"])
    assert "first.h5: 3 pulses" in done.stderr
    # The call of either sensor explains all echoes, so that each could be silent; they still end free space.
    assert report["without_own_echo"] == {"left": 3, "right": 3}
    assert "no echo proves that these sensors emit: left in 3 of 3 pulses, right in 3 of 3 pulses" in done.stderr
    found = ertis.read_map(folder / "first.h5")
    assert report["occupied"] == found.is_occupied.sum() == len(found.occupied_m) > 0
    assert np.hypot(*(found.occupied_m - [POST_M[0] + 10.0, POST_M[1]]).T).max() < 0.1
    assert found.log_odds_at((10.8, 0.1)) < 0


def test_map_leaves_out_pulses_without_a_call(folder):
    done = run(folder, "mixed.h5 --poses poses.tum --json -o echoes.h5")
    report = json.loads(done.stdout)
    assert (report["pulses"], report["left_out"]) == (2, 1)
    assert "note: 1 of 3 pulses left out, because no sensor emitted its call" in done.stderr


def test_sensors_of_the_mounting_file_without_a_recording_are_noted(folder):
    """They emit, so that the others hear their calls."""
    sensors = [("left", 0.15, 90), ("right", -0.15, -90), ("front", 0.0, 0)]
    text = "".join(
        f'[[sensors]]\nname = "{name}"\nposition_m = [0.0, {y}, 0.4]\nyaw_deg = {yaw}\n' for name, y, yaw in sensors
    )
    (folder / "all.toml").write_text(text)
    note = "all.toml contains front, without a recording here; echoes may be of such a sensor's call"
    done = run(folder, f"both.h5 --poses poses.tum -o three.h5 --mounting {folder / 'all.toml'}")
    assert done.stderr.count(note) == 1
    line = f"{folder / 'both.h5'} --mounting {folder / 'all.toml'} -o {folder / 'fused3.h5'}"
    done = CliRunner().invoke(cli, ["fuse", *line.split()])
    assert done.exit_code == 0, done.output
    assert done.stderr.count(note) == 1
    assert "has no image" not in done.stderr


def test_map_of_space_shows_the_height_of_the_post(folder):
    sensor = Sensor(
        name="only",
        position_m=(0.1, 0.0, 0.4),
        processing=Processing(range_m=(0.4, 2.0), directions="3d:1000"),
        emitter=Emitter(level_db=-24.0, diameter_m=0.012),
        electronics=Electronics(noise_dbfs=-60.0),
    )
    post_m = (1.375, 0.225, 0.875)
    scene = Scene(seed=6, rate_hz=10.0, count=2, sensors=(sensor,), points=(Point(position_m=post_m, strength_db=0.0),))
    measurements = [ertis.render(scene, number, sensor="only") for number in range(2)]
    mounting = {"only": (sensor.position_m, sensor.quaternion().tolist())}
    write_recording(folder / "space.h5", measurements, mounting=mounting)
    report = json.loads(run(folder, "space.h5 --poses poses.tum --dimensions 3 --height 0:2 --json -q").stdout)
    found = ertis.read_map(folder / "space.map.h5")
    assert len(report["size_m"]) == found.n_dimensions == 3
    assert np.linalg.norm(found.occupied_m - np.add(post_m, (10.0, 0.0, 0.0)), axis=1).max() < 0.1
    done = CliRunner().invoke(cli, ["plot", str(folder / "space.map.h5"), "-q", "-o", str(folder / "space.png")])
    assert done.exit_code == 0, done.output
    done = CliRunner().invoke(cli, ["info", str(folder / "space.map.h5"), "--json"])
    assert len(json.loads(done.stdout)["cells"]) == 3
    message = "no point of the images lies within the heights of 100 to 200 m; correct --height, which refers to"
    done = run(folder, "space.h5 --poses poses.tum --dimensions 3 --height 100:200 -o high.h5", code=1)
    assert f"ertis: error: {message}" in done.stderr
    assert not (folder / "high.h5").exists()
    done = run(folder, "space.h5 --poses poses.tum --height 100:200 -o high.h5")
    assert f"note: {message}" in done.stderr
    assert not ertis.read_map(folder / "high.h5").is_occupied.any()


def test_map_of_space_is_refused_for_planar_images_and_files(folder):
    done = run(folder, "both.h5 --poses poses.tum --dimensions 3 -o space.ply", code=1)
    assert "images include a planar image, but a map of three dimensions needs directions over elev" in done.output
    done = run(folder, "both.h5 --poses poses.tum --dimensions 3 -o space.pgm", code=1)
    assert "choose a name that ends in .h5 or .ply" in done.output


@pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="only Linux has folders that root cannot write either")
@pytest.mark.parametrize("suffix", ["h5", "ply"])
def test_map_reports_a_folder_without_write_permission_in_one_line(folder, suffix):
    done = CliRunner().invoke(
        cli,
        ["map", str(folder / "both.h5"), "--poses", str(folder / "poses.tum"), "-q", "-o", f"/sys/m.{suffix}"],
    )
    assert done.exit_code == 1
    assert done.stderr == (
        f"ertis: error: /sys/m.{suffix} cannot be written (Permission denied); check the permissions of the file and "
        "its folder, or choose another\n"
    )


def test_maps_of_one_or_several_recordings_are_equal(folder):
    run(folder, "both.h5 --poses poses.tum -q -o one.h5")
    run(folder, "left.h5 right.h5 --poses poses.tum -q -o several.h5")
    one, several = (ertis.read_map(folder / name) for name in ("one.h5", "several.h5"))
    assert np.array_equal(one.log_odds, several.log_odds)


def test_map_uses_the_poses_of_the_recording(folder):
    add_poses(folder / "both.h5", poses(x_m=-5.0), output=folder / "posed.h5")
    run(folder, "posed.h5 -q")
    found = ertis.read_map(folder / "posed.map.h5")
    assert np.hypot(*(found.occupied_m - [POST_M[0] - 5.0, POST_M[1]]).T).max() < 0.1
    run(folder, "posed.h5 --poses poses.tum -q -o given.h5")
    assert ertis.read_map(folder / "given.h5").limits_m[0][0] > 9


def test_map_uses_the_images_and_poses_of_an_energyscape_file(folder):
    add_poses(folder / "both.h5", poses(x_m=-5.0), output=folder / "sited.h5")
    done = CliRunner().invoke(cli, ["process", str(folder / "sited.h5"), "-q", "-o", str(folder / "images.h5")])
    assert done.exit_code == 0, done.output
    with ertis.open_recording(folder / "sited.h5", sensor="left") as recording:
        expected = recording.trajectory
    with ertis.open_energyscapes(folder / "images.h5", sensor="left") as found:
        assert np.array_equal(found.trajectory.time_ns, expected.time_ns)
        assert np.array_equal(found.trajectory.position_m, expected.position_m)
        assert found.trajectory.source == expected.source
    run(folder, "images.h5 -q -o of_images.h5")
    run(folder, "sited.h5 -q -o of_words.h5")
    maps = [ertis.read_map(folder / name) for name in ("of_images.h5", "of_words.h5")]
    assert np.array_equal(maps[0].log_odds, maps[1].log_odds)
    done = CliRunner().invoke(cli, ["map", str(folder / "images.h5"), "--preset", "2d_181_5m", "--force"])
    assert (done.exit_code, "--preset applies to recordings" in done.stderr) == (2, True), done.output


def test_map_writes_pictures_for_ros_and_points(folder):
    report = json.loads(run(folder, "both.h5 --poses poses.tum -q --json --cell 0.1 -o place.pgm").stdout)
    assert report["files"] == [str(folder / "place.pgm"), str(folder / "place.yaml")]
    assert "resolution: 0.1\n" in (folder / "place.yaml").read_text("utf-8")
    run(folder, "both.h5 --poses poses.tum -q -o place.ply")
    assert (folder / "place.ply").read_bytes().startswith(b"ply\n")
    grey = [set((folder / "place.pgm").read_bytes().split(b"\n", 3)[3])]
    run(folder, "both.h5 --poses poses.tum -q --cell 0.1 -o place.pgm --probabilities --force")
    grey.append(set((folder / "place.pgm").read_bytes().split(b"\n", 3)[3]))
    assert "mode: raw\n" in (folder / "place.yaml").read_text("utf-8")
    assert grey[0] == {0, 128, 254}
    assert len(grey[1]) > 3
    assert grey[1] <= {*range(101), 255}


def test_plot_draws_a_map(folder):
    run(folder, "both.h5 --poses poses.tum -q -o drawn.h5")
    for line in (f"plot {folder / 'drawn.h5'}", f"plot {folder / 'drawn.h5'} --kind map -o {folder / 'again.png'}"):
        done = CliRunner().invoke(cli, line.split())
        assert done.exit_code == 0, done.output
        assert "map of" in done.stderr
    assert (folder / "drawn.png").read_bytes() == (folder / "again.png").read_bytes()
    done = CliRunner().invoke(cli, ["plot", str(folder / "drawn.h5"), "--kind", "slices", "--force"])
    assert "is an occupancy map; choose a recording, an energyscape file or a file of acoustic maps" in done.stderr
    done = CliRunner().invoke(cli, ["plot", str(folder / "both.h5"), "--kind", "map", "--force"])
    assert "is HDF5, but not an occupancy map" in done.stderr


@pytest.mark.parametrize("option", ["--sensor left", "--measurement 1", "--peaks 3", "--dynamic-range 20"])
def test_plot_refuses_options_that_a_map_does_not_have(tmp_path, option):
    ertis.write_map(tmp_path / "m.h5", ertis.OccupancyMap(np.array([[0.0, 2.0]]), (0.0, 0.0), 0.1))
    done = CliRunner().invoke(cli, ["plot", str(tmp_path / "m.h5"), *option.split()])
    assert done.exit_code == 2
    assert f"{option.split()[0]} is for --kind image, " in done.stderr
    assert "remove it with map" in done.stderr
    assert not (tmp_path / "m.png").exists()


def test_info_shows_a_map(tmp_path):
    cells = np.array([[-2.0, 0.0, 2.0], [-2.0, 2.0, 2.0]])
    ertis.write_map(tmp_path / "m.h5", ertis.OccupancyMap(cells, (1.0, -2.0), 0.1, 7, 1_700_000_000_000_000_000))
    report = json.loads(CliRunner().invoke(cli, ["info", str(tmp_path / "m.h5"), "--json"]).stdout)
    assert report["kind"] == "occupancy_map"
    assert (report["pulses"], report["cells"], report["occupied"], report["free"]) == (7, [3, 2], 3, 2)
    assert (report["origin_m"], report["size_m"], report["cell_m"]) == ([1.0, -2.0], [0.3, 0.2], 0.1)
    shown = CliRunner().invoke(cli, ["info", str(tmp_path / "m.h5")]).stdout
    assert re.search(r"^last +2023-11-14 22:13:20\.000 UTC$", shown, re.MULTILINE)


def test_order_of_recordings_does_not_change_the_map(folder, tmp_path):
    for name, x_m in (("left", 3.0), ("right", 3.0)):
        add_poses(folder / f"{name}.h5", poses(x_m=x_m), output=tmp_path / f"{name}.h5")
    run(tmp_path, "left.h5 right.h5 -q -o one.h5")
    run(tmp_path, "right.h5 left.h5 -q -o other.h5")
    one, other = (ertis.read_map(tmp_path / name) for name in ("one.h5", "other.h5"))
    assert one.limits_m == other.limits_m
    np.testing.assert_allclose(one.log_odds, other.log_odds, atol=1e-5)
    add_poses(folder / "right.h5", poses(x_m=4.0), output=tmp_path / "right.h5", overwrite=True)
    done = run(tmp_path, "right.h5 left.h5 -q -o third.h5", code=1)
    assert re.search(r"have different poses at \d+ ns; use one trajectory for all \(--poses\)", done.stderr)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("timeless.h5", "all 3 pulses have the same time, 0.000 s; set the clock of the sensors, and record again"),
        ("left.h5", "at 0.000 s, the poses move at 300 m/s and turn at 0 °/s; correct the poses"),
    ],
)
def test_map_refuses_impossible_times_and_poses(folder, name, message):
    with ertis.open_recording(folder / "left.h5") as recording:
        timeless = [replace(each, stamp=replace(each.stamp, timestamp_ns=0)) for each in recording]
        write_recording(folder / "timeless.h5", timeless, overwrite=True)
    path = ertis.Trajectory([0, 10**9], [[0.0, 0.0, 0.0], [300.0, 0.0, 0.0]], [UNTURNED] * 2)
    ertis.write_tum(folder / "rocket.tum", path, overwrite=True)
    done = run(folder, f"{name} --poses rocket.tum --mounting both.h5 -o no.h5", code=1)
    assert f"ertis: error: {message}\n" in done.stderr
    assert not (folder / "no.h5").exists()


def test_map_leaves_out_pulses_outside_of_the_poses(folder):
    ertis.write_tum(folder / "late.tum", poses(start_ns=50_000_000))
    done = run(folder, "both.h5 --poses late.tum --json -o late.h5")
    assert "note: 1 pulse of 3 outside of the time of the poses left out" in done.stderr
    assert json.loads(done.stdout)["left_out"] == 1


def of_camera(trajectory):
    """Return the poses of a camera that looks ahead on the platform."""
    optical = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return trajectory.replace(rotation_xyzw=(Rotation.from_quat(trajectory.rotation_xyzw) * optical).as_quat())


def test_map_notes_poses_of_a_camera_and_converts_them(folder):
    ertis.write_tum(folder / "camera.tum", of_camera(poses()))
    with pytest.warns(ertis.PoseWarning, match="as that of a camera"):
        add_poses(folder / "both.h5", of_camera(poses()), output=folder / "of_camera.h5")
    note = (
        "its −y axis points up, as that of a camera does (z forward, y down); convert them with --pose-axes camera "
        "(ertis import poses, ertis map)"
    )
    run(folder, "both.h5 --poses poses.tum -q -o level.h5")
    for number, line in enumerate(("both.h5 --poses camera.tum", "of_camera.h5")):
        done = run(folder, f"{line} -o turned{number}.h5")
        assert done.stderr.count(note) == 1
        assert "PoseWarning" not in done.stderr
        done = run(folder, f"{line} -o converted{number}.h5 --pose-axes camera")
        assert other_notes(done) == []
        maps = [ertis.read_map(folder / name) for name in ("level.h5", f"converted{number}.h5")]
        assert maps[0].log_odds.shape == maps[1].log_odds.shape
        assert maps[0].log_odds == pytest.approx(maps[1].log_odds, abs=1e-4)
    imported = [
        "import",
        "poses",
        *(str(folder / each) for each in ("both.h5", "camera.tum")),
        "-o",
        str(folder / "i.h5"),
    ]
    for turn, wanted in (([], 1), (["--pose-axes", "camera", "--force"], 0)):
        done = CliRunner().invoke(cli, [*imported, *turn])
        assert (done.exit_code, done.stderr.count(note), "PoseWarning" in done.stderr) == (0, wanted, False)
    done = CliRunner().invoke(cli, ["info", str(folder / "of_camera.h5"), "--json"])
    assert note in json.loads(done.stdout)["sensors"][0]["pose_warning"]
    done = CliRunner().invoke(
        cli, ["process", str(folder / "of_camera.h5"), "-o", str(folder / "l.h5"), "--level", "-q"]
    )
    assert (
        f"sensor left: most poses tilt the platform by more than 30°: its z axis is 90° from vertical, and {note}"
        in done.stderr
    )


def test_map_reads_poses_of_kitti_with_their_times(folder):
    (folder / "kitti.txt").write_text("".join("1 0 0 0 0 1 0 0 0 0 1 0\n" for _ in range(2)))
    (folder / "times.txt").write_text("0.0\n1.0\n")
    assert "no times; add the file of their times" in run(folder, "both.h5 --poses kitti.txt -o k.h5", code=1).stderr
    run(folder, "both.h5 --poses kitti.txt -o k.h5 --times times.txt --pose-axes camera-world")
    (folder / "ms.tum").write_text("0 10 0 0 0 0 0 1\n1000 10 0 0 0 0 0 1\n")
    assert "times from 0 to 1000 are read as seconds" in run(folder, "both.h5 --poses ms.tum -o m.h5").stderr
    assert other_notes(run(folder, "both.h5 --poses ms.tum -o s.h5 --time-unit ms")) == []


def test_map_states_pulses_between_distant_poses(folder):
    few = poses()
    ertis.write_tum(folder / "few.tum", few.replace(time_ns=2 * few.time_ns))
    done = run(folder, "both.h5 --poses few.tum -o few.h5")
    assert "note: 2 of 3 pulses between poses more than a second apart, which are interpolated" in done.stderr
    assert other_notes(run(folder, "both.h5 --poses poses.tum -o near.h5")) == []


def test_map_refuses_poses_at_other_times(folder):
    ertis.write_tum(folder / "other.tum", poses(start_ns=10**12))
    done = run(folder, "both.h5 --poses other.tum -o other.h5", code=1)
    assert "all pulses lie outside of the time of the poses: pulses from 0.000 s to 0.200 s, poses from" in done.stderr
    assert not (folder / "other.h5").exists()


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        ("both.h5", 2, "contains no poses of the platform; add --poses FILE"),
        ("both.h5 left.h5 --poses poses.tum", 2, "contain the same sensor 'left';"),
        (
            "both.h5 --poses poses.tum -o place.tif",
            1,
            "ends in '.tif'; choose a name that ends in .h5, .mcap, .pgm, .ply",
        ),
        ("both.h5 --poses none.tum", 1, "none.tum"),
        ("both.h5 --time-unit ms", 2, "--time-unit requires --poses; add --poses FILE, or remove --time-unit"),
        ("both.h5 --poses poses.tum --probabilities -o place.h5", 1, "leave out probabilities, or choose a name"),
        ("passive.h5 --poses poses.tum", 1, "passive.h5: all measurements are passive and have no echoes"),
        ("both.h5 --poses poses.tum --cell 0", 2, "--cell"),
        ("both.h5 --poses poses.tum -o both.h5", 1, "both.h5"),
    ],
)
def test_map_refuses_input_that_does_not_fit(folder, line, code, message):
    assert message in run(folder, line, code=code).stderr


def test_commands_and_code_of_the_page_run(tmp_path):
    text = page("mapping")
    for command in commands_in(text):
        run_here(tmp_path, command)
        if command == "example moving_platform":
            scene_file = tmp_path / "moving_platform.toml"
            scene_file.write_text(scene_file.read_text("utf-8").replace("count = 6", "count = 2"), "utf-8")
    assert ertis.read_map(tmp_path / "moving_platform.map.h5").n_groups == 2
    assert 'image: "place.pgm"' in (tmp_path / "place.yaml").read_text("utf-8")
    mapping, counting = python_in(text)
    assert "[" in run_code_here(tmp_path, mapping)
    n_occupied, n_outside = map(int, run_code_here(tmp_path, counting).split())
    assert 2 * n_outside < n_occupied


def test_map_beside_its_recording_is_no_recording(tmp_path):
    shutil.copy(Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5", tmp_path / "rec.h5")
    ertis.write_map(tmp_path / "rec.map.h5", ertis.OccupancyMap(np.array([[0.0, 2.0]]), (0.0, 0.0), 0.1))
    assert [each.path.name for each in find_recordings([tmp_path])] == ["rec.h5"]


@pytest.mark.parametrize(("name", "value"), [("cell_m", 0.1), ("origin_x_m", 1.0)])
def test_map_whose_scale_contradicts_its_cells_is_refused(tmp_path, name, value):
    """Another program may state a right SHA-256 of contradictory numbers; its rule is that of formats.md."""
    path = tmp_path / "m.h5"
    ertis.write_map(path, ertis.OccupancyMap(np.ones((20, 30)), (0.0, 0.0), 0.05))
    with h5py.File(path, "r+") as file:
        file.attrs.modify(name, value)
        variables = hashlib.sha256()
        for each in ("log_odds", "x", "y"):
            variables.update(each.encode() + file[each][:].tobytes())
        numbers = [file.attrs[each] for each in ("cell_m", "origin_x_m", "origin_y_m")]
        counts = [file.attrs[each] for each in ("n_groups", "time_ns")]
        packed = np.array(numbers, "<f8").tobytes() + np.array(counts, "<i8").tobytes()
        file.attrs["content_sha256"] = hashlib.sha256(variables.digest() + packed).hexdigest()
    with pytest.raises(ertis.ErtisError, match="cell_m or origin_x_m contradicts the positions of the cells"):
        ertis.read_map(path)


def test_map_notes_poses_that_it_could_not_compare_with_the_echoes(folder):
    moving = poses().replace(position_m=[[10.0, 0.0, 0.0], [10.5, 0.0, 0.0]])
    ertis.write_tum(folder / "moving.tum", moving)
    done = run(folder, "both.h5 --poses moving.tum --json -o moving.h5")
    note = "the poses were not compared with the echoes: they show the motion in "
    assert f"note: {note}" in done.stderr
    assert any(each.startswith(note) for each in json.loads(done.stdout)["notes"])
