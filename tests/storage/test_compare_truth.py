"""`ertis compare` of fused images and maps, from recordings whose scene is the truth."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba.analysis.compare_places import positions_m
from ertis_numba.storage import read_map_truth, write_recording

pytestmark = pytest.mark.usefixtures("sound_unchecked")

POSTS_M = ((1.6, 0.4, 0.4), (1.2, -0.5, 0.4))
_SENSOR = """
[[sensors]]
name = "{name}"
position_m = [0.15, {left_m}, 0.4]
yaw_deg = {yaw_deg}
recording = {{sample_rate_hz = 200000.0, n_samples = 5000, encoding = "float32"}}
processing = {{range_m = [0.4, 2.4], directions = "90", range_decimation = 4}}
emitter.level_db = -24.0
electronics.noise_dbfs = -80.0
"""
SENSORS = "".join(
    _SENSOR.format(name=name, left_m=left_m, yaw_deg=yaw_deg)
    for name, left_m, yaw_deg in (("left", 0.15, 20.0), ("right", -0.15, -20.0))
)
SCENE = f"""
seed = 6
rate_hz = 10.0
count = 3
effects = {{absorption = true}}
[platform]
waypoints = [[0.0, 5.0, -3.0, 0.0, 90.0], [0.2, 5.0, -2.9, 0.0, 100.0]]
{SENSORS}
"""


def world(place_m):
    """Place in the world of a place in the frame of the platform at the first pulse, which faces the world's y."""
    return [5.0 - place_m[1], -3.0 + place_m[0], place_m[2]]


POINTS = "".join(f"[[points]]\nposition_m = {world(place_m)}\nstrength_db = 0.0\n" for place_m in POSTS_M)


def run(line, code=0):
    done = CliRunner().invoke(cli, line.split())
    assert done.exit_code == code, done.output
    return done


def report(line):
    return json.loads(run(f"{line} --json").stdout)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Recordings of a turning platform, of its sensors, of another scene, and of one without truth."""
    made = tmp_path_factory.mktemp("truth")
    (made / "scene.toml").write_text(SCENE + POINTS)
    run(f"simulate {made}/scene.toml -q")
    for name in ("left", "right"):
        with ertis.open_recording(made / "scene.h5", sensor=name) as recording:
            truth, rows = recording.truth, list(recording)
            placed = {"mounting": {name: (recording.translation_m, recording.rotation_xyzw)}}
            placed["poses"] = recording.trajectory
        write_recording(made / f"{name}.h5", rows, truth={name: truth}, **placed)
    other = replace(truth, scene=truth.scene.replace("4.6", "4.7"))
    assert other != truth
    write_recording(made / "other_right.h5", rows, truth={"right": other}, **placed)
    write_recording(made / "real_right.h5", rows, **placed)
    run(f"fuse {made}/scene.h5 -q -o {made}/fused.h5")
    run(f"map {made}/scene.h5 -q -o {made}/place.h5")
    return made


def test_compare_of_fused_images_finds_all_posts(folder):
    found = report(f"compare {folder}/fused.h5")
    assert found["pulses"] == 3
    assert (found["matched"], found["missed"], found["spurious"]) == (6, 0, 0)
    assert 0 < found["error_cm"] < 1.0
    heading, row = run(f"compare {folder}/fused.h5").stdout.splitlines()
    assert heading.split() == list(found)
    assert row.split() == [str(value) for value in found.values()]


def test_fused_truth_is_in_the_frame_of_the_platform(folder):
    with ertis.open_energyscapes(folder / "fused.h5") as images:
        first, last = (positions_m(images.truth.reflectors[row]) for row in (0, 2))
        assert sorted(first.round(3).tolist()) == sorted(map(list, POSTS_M))
    ahead_m = np.array(POSTS_M) - [0.1, 0.0, 0.0]
    turned_m = Rotation.from_euler("z", -10.0, degrees=True).apply(ahead_m)
    assert sorted(last.round(3).tolist()) == pytest.approx(np.array(sorted(turned_m.round(3).tolist())), abs=2e-3)


def test_compare_of_fused_images_counts_displaced_points(folder, tmp_path):
    """All points are moved by 15 cm, so that the posts are missed, and nothing is at the points."""
    with ertis.open_energyscapes(folder / "fused.h5") as images:
        moved = []
        for image in images:
            place_m = image.points.position_m + np.float32([0.0, 0.15, 0.0])
            moved.append(image.replace(points=image.points.replace(position_m=place_m)))
        ertis.write_energyscapes(tmp_path / "moved.h5", moved, truth={"base_link": images.truth})
    found = report(f"compare {tmp_path}/moved.h5")
    assert (found["matched"], found["missed"], found["spurious"]) == (0, 6, found["points"])
    assert found["error_cm"] is None
    assert run(f"compare {tmp_path}/moved.h5").stdout.split()[-1] == "-"


def test_compare_of_maps_finds_the_posts_in_the_world(folder):
    found = report(f"compare {folder}/place.h5")
    assert list(found) == ["pulses", "matched", "missed", "occupied", "spurious", "error_cm"]
    assert (found["pulses"], found["matched"], found["missed"], found["spurious"]) == (3, 2, 0, 0)
    assert found["occupied"] == ertis.read_map(folder / "place.h5").is_occupied.sum()
    assert 0 < found["error_cm"] < 7.5
    places_m = {tuple(row) for row in positions_m(read_map_truth(folder / "place.h5").reflectors[2]).round(6)}
    assert places_m == {tuple(np.round(world(place_m), 6)) for place_m in POSTS_M}


def test_compare_of_maps_counts_displaced_cells(folder, tmp_path):
    found = ertis.read_map(folder / "place.h5")
    shifted = found.replace(origin_m=(found.origin_m[0] + 0.3, found.origin_m[1]))
    ertis.write_map(tmp_path / "shifted.h5", shifted, truth=read_map_truth(folder / "place.h5"))
    errors = report(f"compare {tmp_path}/shifted.h5")
    assert (errors["matched"], errors["missed"], errors["spurious"]) == (0, 2, errors["occupied"])


def test_compare_of_maps_from_other_poses_moves_the_truth(folder, tmp_path):
    """Poses in another frame turn and move the map, like those of an odometry that begins at its origin."""
    with ertis.open_recording(folder / "scene.h5", sensor="left") as recording:
        path = recording.trajectory
    turn = Rotation.from_euler("z", 70.0, degrees=True)
    moved = path.replace(
        position_m=turn.apply(path.position_m.copy()) + np.array([-40.0, 7.0, 0.0]),
        rotation_xyzw=(turn * Rotation.from_quat(path.rotation_xyzw)).as_quat(),
    )
    ertis.write_tum(tmp_path / "moved.tum", moved)
    done = run(f"map {folder}/scene.h5 --poses {tmp_path}/moved.tum -o {tmp_path}/moved.h5")
    note = "poses are not those of the simulated scene. The ground truth is moved to fit them, and sensors remain up to"
    assert note in done.stderr
    found = report(f"compare {tmp_path}/moved.h5")
    assert (found["matched"], found["missed"], found["spurious"]) == (2, 0, 0)


def write_mountings(path, *, x_m, left_m):
    """Write the mountings of the scene, whose sensors are 0.15 m to the left and to the right."""
    path.write_text(
        "".join(
            f'[[sensors]]\nname = "{name}"\nposition_m = [{x_m}, {y_m}, 0.4]\nyaw_deg = {yaw_deg}\n'
            for name, y_m, yaw_deg in (("left", left_m, 20.0), ("right", -0.15, -20.0))
        )
    )


def test_fusion_with_another_mounting_file_moves_the_truth(folder, tmp_path):
    """The platform's origin lies half a metre behind, so that all places move by the same amount."""
    write_mountings(tmp_path / "other.toml", x_m=0.65, left_m=0.15)
    done = run(f"fuse {folder}/scene.h5 --mounting {tmp_path}/other.toml -o {tmp_path}/other.h5")
    assert "mountings are not those" not in done.stderr
    found = report(f"compare {tmp_path}/other.h5")
    assert (found["matched"], found["missed"], found["spurious"]) == (6, 0, 0)


def test_map_with_wrong_mountings_has_a_note(folder, tmp_path):
    write_mountings(tmp_path / "wrong.toml", x_m=0.15, left_m=0.25)
    done = run(f"map {folder}/scene.h5 --mounting {tmp_path}/wrong.toml -o {tmp_path}/wrong.h5")
    assert "poses are not those of the simulated scene. The ground truth is moved to fit them" in done.stderr


def test_recordings_of_single_sensors_have_the_truth_of_their_platform(folder, tmp_path):
    run(f"fuse {folder}/left.h5 {folder}/right.h5 -q -o {tmp_path}/two.h5")
    assert report(f"compare {tmp_path}/two.h5") == report(f"compare {folder}/fused.h5")


def test_truth_of_some_sensors_is_left_out_of_fused_images(folder, tmp_path):
    done = run(f"fuse {folder}/left.h5 {folder}/real_right.h5 -o {tmp_path}/two.h5")
    assert f"no ground truth is stored, because sensor right of {folder}/real_right.h5 has none" in done.stderr
    message = "two.h5 contains no ground truth; fuse simulated recordings of one scene with 'ertis fuse'"
    assert message in run(f"compare {tmp_path}/two.h5", code=1).stderr


def test_truth_of_different_scenes_is_left_out_of_maps(folder, tmp_path):
    done = run(f"map {folder}/left.h5 {folder}/other_right.h5 -o {tmp_path}/two.h5")
    assert "no ground truth is stored, because sensors left and right come from different scenes" in done.stderr
    message = "two.h5 contains no ground truth; map simulated recordings of one scene with 'ertis map', as .h5"
    assert message in run(f"compare {tmp_path}/two.h5", code=1).stderr


def test_recordings_without_truth_yield_no_note(folder, tmp_path):
    rest = ertis.Trajectory(np.array([0, 10**9]), np.zeros((2, 3)), [(0.0, 0.0, 0.0, 1.0)] * 2)
    ertis.write_tum(tmp_path / "rest.tum", rest)
    done = run(f"map {folder}/real_right.h5 --poses {tmp_path}/rest.tum -o {tmp_path}/real.map.h5")
    assert "ground truth" not in done.stderr


def test_map_of_images_has_the_truth_of_the_recording(folder, tmp_path):
    run(f"process {folder}/scene.h5 -q -o {tmp_path}/images.h5")
    run(f"map {tmp_path}/images.h5 -q -o {tmp_path}/place.h5")
    assert report(f"compare {tmp_path}/place.h5") == report(f"compare {folder}/place.h5")


def test_map_heights_limit_the_truth(folder, tmp_path):
    run(f"map {folder}/scene.h5 -q --height 1:2 -o {tmp_path}/high.h5")
    assert read_map_truth(tmp_path / "high.h5").reflectors == ((),) * 3
    assert report(f"compare {tmp_path}/high.h5")["missed"] == 0


def test_changed_truth_of_a_map_is_refused(folder, tmp_path):
    (tmp_path / "place.h5").write_bytes((folder / "place.h5").read_bytes())
    with h5py.File(tmp_path / "place.h5", "r+") as file:
        file["truth/range"][0, 0] = 9.0
    assert "SHA-256 of the content differs" in run(f"compare {tmp_path}/place.h5", code=1).stderr


def test_peaks_of_fused_images_name_compare(folder):
    message = f"fused.h5 has fused images, which have points instead of peaks; use 'ertis compare {folder}/fused.h5'"
    assert message in run(f"peaks {folder}/fused.h5 --truth", code=1).stderr


def test_compare_of_a_map_refuses_a_sensor(folder):
    assert "--sensor does not apply to the map" in run(f"compare {folder}/place.h5 --sensor left", code=2).stderr


def test_compare_of_fused_and_other_images_asks_for_a_sensor(folder, tmp_path):
    with ertis.open_energyscapes(folder / "fused.h5") as images:
        fused, truth = list(images), images.truth
    single = [image.replace(points=None, stamp=ertis.Stamp(sensor="left")) for image in fused[:1]]
    ertis.write_energyscapes(tmp_path / "mixed.h5", [*fused, *single], truth={"base_link": truth})
    done = run(f"compare {tmp_path}/mixed.h5", code=2)
    assert "has fused images and images of sensors; choose one of base_link, left with --sensor" in done.stderr
    found = report(f"compare {tmp_path}/mixed.h5 --sensor base_link")
    assert (found["matched"], found["missed"]) == (6, 0)
