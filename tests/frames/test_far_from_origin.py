"""Maps, points and poses in coordinates of a country, such as UTM, keep their millimetres."""

import csv
from dataclasses import replace

import numpy as np
import plyfile
import pytest
from ertis_bench.platform_trials.furnished_rooms import mountings
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba.analysis.point_finder import PointFinder
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.geometry import Grid
from ertis_numba.interop import export
from ertis_numba.ros import RosPublisher
from tests.interop.test_export_points import images
from tests.mapping.test_mapping import UNTURNED, views

UTM_M = (458_071.153, 5_429_375.521, 312.25)
TURN = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))  # a quarter turn to the left
FINDING = {"top": 40, "min_level_db": -60.0}
PCD_TYPES = {("F", "4"): "<f4", ("F", "8"): "<f8", ("U", "2"): "<u2", ("U", "4"): "<u4", ("I", "4"): "<i4"}


def placed(cloud, place_m=UTM_M):
    """Positions of points that a sensor with the rotation TURN sees from a place: (point, 3) float64."""
    return Rotation.from_quat(TURN).apply(cloud.position_m.astype(np.float64)) + place_m


def clouds(given):
    return [
        PointExtractor(each.settings, Grid(each.azimuth_rad, each.elevation_rad), **FINDING)(each) for each in given
    ]


def read_ply(path):
    found = plyfile.PlyData.read(path)["vertex"].data
    return np.column_stack([found[axis] for axis in "xyz"])


def read_pcd(path):
    """Read positions as the format is documented, in the types that the header states."""
    head, _, rest = path.read_bytes().partition(b"DATA ")
    kind, _, body = rest.partition(b"\n")
    stated = dict(line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#"))
    names, types = stated["FIELDS"].split(), zip(stated["TYPE"].split(), stated["SIZE"].split(), strict=True)
    if kind == b"ascii":
        columns = zip(*(line.split() for line in body.decode().splitlines()), strict=True)
        found = dict(zip(names, columns, strict=True))
        return np.column_stack([np.array(found[axis], np.float64) for axis in "xyz"])
    found = np.frombuffer(body, [(name, PCD_TYPES[each]) for name, each in zip(names, types, strict=True)])
    return np.column_stack([found[axis] for axis in "xyz"])


def read_csv(path):
    with path.open(newline="") as file:
        return np.array([[float(row[f"{axis}_m"]) for axis in "xyz"] for row in csv.DictReader(file)])


@pytest.mark.parametrize(
    ("suffix", "read", "options"),
    [
        ("ply", read_ply, {}),
        ("ply", read_ply, {"text": True}),
        ("pcd", read_pcd, {}),
        ("pcd", read_pcd, {"text": True}),
        ("csv", read_csv, {}),
    ],
)
def test_points_of_a_georeferenced_sensor_keep_their_place(tmp_path, suffix, read, options):
    given = images()
    (path,) = export(tmp_path / f"a.{suffix}", given, mounting={"eRTIS-7": (UTM_M, TURN)}, **options, **FINDING)
    wanted = np.concatenate([placed(cloud) for cloud in clouds(given)])
    assert np.abs(read(path) - wanted).max() < 1e-6


def test_pcd_has_the_positions_that_pcl_reads_unless_they_lose_digits(tmp_path):
    sizes = {}
    for name, place_m in {"near": (1.0, 2.0, 3.0), "far": UTM_M, "high": (0.0, 0.0, 900.1)}.items():
        (path,) = export(tmp_path / f"{name}.pcd", images(), mounting={"eRTIS-7": (place_m, TURN)}, **FINDING)
        sizes[name] = path.read_bytes().partition(b"SIZE ")[2][:5]
        wanted = np.concatenate([placed(cloud, place_m) for cloud in clouds(images())])
        assert np.abs(read_pcd(path) - wanted).max() < 1e-5
    assert sizes == {"near": b"4 4 4", "far": b"8 8 8", "high": b"8 8 8"}


def test_csv_has_short_numbers_where_float32_is_exact(tmp_path):
    (path,) = export(tmp_path / "a.csv", images(), **FINDING)
    with path.open(newline="") as file:
        assert max(len(row["x_m"]) for row in csv.DictReader(file)) < 15


def test_mcap_has_points_near_the_sensor_and_its_place_in_float64(tmp_path):
    reader = pytest.importorskip("mcap_ros2.reader")
    (path,) = export(tmp_path / "a.mcap", images(), mounting={"eRTIS-7": (UTM_M, TURN)}, topics=["points"], **FINDING)
    found = {message.channel.topic: message.ros_msg for message in reader.read_ros2_messages(path)}
    (transform,) = found["/tf_static"].transforms
    place, turn = transform.transform.translation, transform.transform.rotation
    message = found["/eRTIS_7/points"]
    assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", message.header.frame_id)
    rows = np.frombuffer(message.data, "<f4").reshape(message.width, -1)[:, :3].astype(np.float64)
    rotation = Rotation.from_quat((turn.x, turn.y, turn.z, turn.w))
    found_m = rotation.apply(rows) + np.array([place.x, place.y, place.z])
    assert np.abs(found_m - placed(clouds(images())[-1])).max() < 1e-6


class Topics:
    """Participant that keeps the messages of each topic."""

    def __init__(self):
        self.messages = {}

    def topic(self, name, message, *, latched=False):  # noqa: ARG002
        class Kept(list):
            publish = list.append

        return self.messages.setdefault(name, Kept())


@pytest.mark.parametrize(("place_m", "frame"), [((0.2, 0.1, 0.0), "base_link"), (UTM_M, "base_link_local")])
def test_fused_points_have_a_frame_near_the_sensors(place_m, frame):
    participant = Topics()
    ros = RosPublisher(participant, topics=["points", "sonar_image"])
    both = {name: images(name, 1)[0] for name in ("left", "right")}
    for each in both.values():
        ros.publish(each, (place_m, TURN))
    for each in both.values():  # Now, both sensors are expected.
        ros.publish(each.replace(stamp=replace(each.stamp, sync_count=2**40 + 9)), (place_m, TURN))
    message = participant.messages["/fused/points"][-1]
    assert message["header"]["frame_id"] == frame
    children = {
        each["child_frame_id"]: each["transform"] for each in participant.messages["/tf_static"][-1]["transforms"]
    }
    origin = children.get(frame, {"translation": {"x": 0.0, "y": 0.0, "z": 0.0}})["translation"]
    assert "base_link_local_sonar" not in children
    rows = np.frombuffer(message["data"], "<f4").reshape(message["width"], -1)[:, :3].astype(np.float64)
    found = rows + [origin[axis] for axis in "xyz"]
    wanted = placed(PointFinder()(both["left"]), place_m)
    distance_m = np.linalg.norm(found[:, None] - wanted, axis=2).min(axis=0)
    assert distance_m.max() < 1e-4


@pytest.mark.parametrize("n_dimensions", [2, 3])
def test_ply_of_a_georeferenced_map_keeps_all_rows_of_cells(tmp_path, n_dimensions):
    log_odds = np.full((20,) * n_dimensions, -2.0)
    log_odds[..., 3:17, 10] = 3.0
    occupancy = ertis.OccupancyMap(log_odds, UTM_M[:n_dimensions], 0.05)
    ertis.write_map(tmp_path / "m.ply", occupancy)
    found = read_ply(tmp_path / "m.ply")
    assert found[:, :n_dimensions].tolist() == occupancy.occupied_m.tolist()
    assert len(np.unique(found[:, 1])) == 14


def test_map_does_not_depend_on_the_origin_of_the_world():
    near, far = ertis.Mapper(mountings()), ertis.Mapper(mountings())
    for group, (place_m, rotation) in views():
        near.add(group, (place_m, rotation))
        far.add(group, (tuple(np.add(place_m, (458_071.15, 5_429_375.5, 0.0))), rotation))
    assert np.abs(far.map.log_odds - near.map.log_odds).max() < 1e-4
    assert np.array(far.map.origin_m) - near.map.origin_m == pytest.approx(np.array([458_071.15, 5_429_375.5]))


def test_tum_file_keeps_micrometres_of_utm(tmp_path):
    place_m = np.array([UTM_M, (458_071.153_001, 5_429_375.521_001, 312.250_001)])
    path = ertis.Trajectory([0, 1], place_m, [UNTURNED] * 2)
    ertis.write_tum(tmp_path / "a.tum", path)
    assert ertis.read_trajectory(tmp_path / "a.tum").position_m.tolist() == place_m.tolist()
