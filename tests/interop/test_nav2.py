"""Files for Nav2, and its costmap rules applied to fused scans.

The harness follows the documentation of nav2_costmap_2d and laser_geometry: readings outside ``range_min`` to
``range_max`` are dropped, and so are infinite ones unless ``inf_is_valid``; readings mark their cell up to
``obstacle_max_range``, and clear the cells before it up to ``raytrace_max_range``.
"""

import ast
import math
from pathlib import Path

import numpy as np
import pytest

from ertis_numba.frames import PointCloud, Stamp
from ertis_numba.interop.ros_messages import odometry_message, odometry_transform
from ertis_numba.interop.scans import scan_message
from ertis_numba.motion.planar_pose import PlanarPose
from tests.files import image

yaml = pytest.importorskip("yaml")

EXAMPLES = Path(__file__).parents[2] / "examples"
TEXT = (EXAMPLES / "nav2.yaml").read_text("utf-8")
PARAMS = yaml.safe_load(TEXT)
COSTMAPS = {name: PARAMS[name][name]["ros__parameters"] for name in ("local_costmap", "global_costmap")}
TIME_NS = 1_700_000_000_123_456_789
CELL_M = 0.05
HALF_CELLS = 80
FREE, LETHAL, UNKNOWN = 0, 254, 255


def scan_of(places_m, **fields):
    """The scan of a platform with confirmed reflectors at places."""
    azimuth_deg = np.arange(360) - 179.5
    made = image(azimuth_deg, np.zeros(360), range_m=np.linspace(0.05, 4.0, 200), seed=3)
    made = made.replace(stamp=Stamp(sensor="base_link", timestamp_ns=TIME_NS))
    cloud = PointCloud(
        np.array([[*place, 0.4] for place in places_m], np.float32).reshape(-1, 3),
        np.full(len(places_m), 0.1, np.float32),
        made.settings,
        made.stamp,
        uncertainty_m=np.tile(np.float32([0.002, 0.001]), (len(places_m), 1)),
        confirmed=np.ones(len(places_m), bool),
    )
    return scan_message(made.replace(points=cloud)) | fields


def readings(scan, source):
    """Range and angle of the readings that laser_geometry converts to points, and of those that clear only."""
    for number, range_m in enumerate(scan["ranges"]):
        angle = scan["angle_min"] + number * scan["angle_increment"]
        if source["inf_is_valid"] and math.isinf(range_m) and range_m > 0:
            yield scan["range_max"] - 1e-4, angle
        elif scan["range_min"] <= range_m < scan["range_max"]:  # False for NaN and infinity.
            yield range_m, angle


def costmap(scans, source):
    """Cells around the platform, which does not move: (x, y) uint8."""
    cells = np.full((2 * HALF_CELLS, 2 * HALF_CELLS), UNKNOWN, np.uint8)

    def cell(range_m, angle):
        return tuple(int(HALF_CELLS + range_m * part // CELL_M) for part in (math.cos(angle), math.sin(angle)))

    for scan in scans:
        for range_m, angle in readings(scan, source):
            end_m = min(range_m, source["raytrace_max_range"])
            if source["clearing"]:
                for along_m in np.arange(source["raytrace_min_range"], end_m - CELL_M, CELL_M / 2):
                    cells[cell(along_m, angle)] = FREE
        for range_m, angle in readings(scan, source):
            is_marked = source["obstacle_min_range"] <= range_m <= source["obstacle_max_range"]
            if source["marking"] and is_marked and source["min_obstacle_height"] <= 0 <= source["max_obstacle_height"]:
                cells[cell(range_m, angle)] = LETHAL
    return cells


def at(cells, x_m, y_m):
    column = int(HALF_CELLS + x_m // CELL_M)
    row = int(HALF_CELLS + y_m // CELL_M)
    return cells[column - 1 : column + 2, row - 1 : row + 2]


@pytest.fixture(params=COSTMAPS)
def source(request):
    layer = COSTMAPS[request.param]["obstacle_layer"]
    return layer[layer["observation_sources"]]


def test_parameters_have_no_aliases_which_ros_refuses():
    events = [*yaml.parse(TEXT)]
    assert not [event for event in events if isinstance(event, yaml.AliasEvent)]
    assert not [event for event in events if getattr(event, "anchor", None)]


def test_costmaps_use_the_topic_and_the_frames_of_ertis_ros(source):
    scan = scan_of([(1.0, 0.5)])
    assert (source["topic"], source["data_type"], source["sensor_frame"]) == ("/fused/scan", "LaserScan", "")
    pose = PlanarPose(TIME_NS, 0.0, 0.0, 0.0, np.zeros((3, 3)))
    transform, odometry = odometry_transform(pose), odometry_message(pose, None)
    for costmap_of in COSTMAPS.values():
        assert costmap_of["robot_base_frame"] == scan["header"]["frame_id"] == transform["child_frame_id"]
    assert COSTMAPS["local_costmap"]["global_frame"] == transform["header"]["frame_id"]
    assert COSTMAPS["global_costmap"]["global_frame"] == PARAMS["map_server"]["ros__parameters"]["frame_id"] == "map"
    # The transform has the time of the scan, which Nav2 looks up.
    assert transform["header"]["stamp"] == odometry["header"]["stamp"] == scan["header"]["stamp"]
    assert odometry["child_frame_id"] == "base_link"


def test_layers_are_defined_in_the_order_of_nav2():
    for each in COSTMAPS.values():
        assert {"obstacle_layer", "inflation_layer"} <= {*each["plugins"]} <= {*each}
        assert each["plugins"][-1] == "inflation_layer"  # It inflates the obstacles of the layers before it.


def test_reflectors_become_obstacles_and_the_way_to_them_becomes_free(source):
    places_m = [(2.0, 0.8), (-1.2, 1.5), (0.4, -2.5)]
    cells = costmap([scan_of(places_m)], source)
    for x_m, y_m in places_m:
        assert (at(cells, x_m, y_m) == LETHAL).any()
        assert (at(cells, x_m / 2, y_m / 2) == FREE).any()
    assert np.count_nonzero(cells == LETHAL) == len(places_m)


def test_beams_without_an_echo_are_neither_free_nor_occupied(source):
    cells = costmap([scan_of([(2.0, 0.8)])], source)
    assert (at(cells, -1.0, 0.0) == UNKNOWN).all()
    assert (at(cells, 0.0, 2.0) == UNKNOWN).all()
    assert (costmap([scan_of([])], source) == UNKNOWN).all()
    cleared = costmap([scan_of([])], source | {"inf_is_valid": True})
    assert (cleared == FREE).sum() > 1000  # That is why it is false.


def test_a_farther_reading_clears_an_obstacle_that_has_moved_away(source):
    before, after = scan_of([(1.0, 0.0)]), scan_of([(2.0, 0.0)])
    assert (at(costmap([before], source), 1.0, 0.0) == LETHAL).any()
    assert not (at(costmap([before, after], source), 1.0, 0.0) == LETHAL).any()
    assert (at(costmap([before, scan_of([])], source), 1.0, 0.0) == LETHAL).any()  # Silence clears nothing.


def test_readings_beyond_the_obstacle_range_mark_nothing(source):
    assert source["obstacle_max_range"] <= source["raytrace_max_range"] < 4.0
    cells = costmap([scan_of([(3.8, 0.0)])], source)
    assert not (cells == LETHAL).any()
    assert (at(cells, 3.0, 0.0) == FREE).any()


@pytest.mark.parametrize("range_m", [math.inf, -math.inf, math.nan, 0.01, 4.5])
def test_readings_outside_the_range_of_the_scan_are_dropped(source, range_m):
    assert (costmap([scan_of([], ranges=[range_m] * 360)], source) == UNKNOWN).all()


def test_scans_obey_rep_117():
    ranges_m = np.array(scan_of([(2.0, 0.8), (-1.2, 1.5)])["ranges"])
    scan = scan_of([])
    assert not np.isnan(ranges_m).any()
    assert (ranges_m[~np.isfinite(ranges_m)] == np.inf).all()
    assert scan["range_min"] < ranges_m.min() < scan["range_max"]
    n_beams = round((scan["angle_max"] - scan["angle_min"]) / scan["angle_increment"]) + 1
    assert len(scan["ranges"]) == len(scan["intensities"]) == n_beams == 360


def test_rviz_shows_the_topics_of_nav2_and_of_the_fusion():
    manager = yaml.safe_load((EXAMPLES / "nav2.rviz").read_text("utf-8"))["Visualization Manager"]
    topics = {each["Topic"]["Value"]: each["Topic"] for each in manager["Displays"] if "Topic" in each}
    assert {"/map", "/local_costmap/costmap", "/fused/scan", "/fused/points", "/odom", "/plan"} <= {*topics}
    assert topics["/map"]["Durability Policy"] == "Transient Local"  # The map is sent once.
    assert manager["Global Options"]["Fixed Frame"] == "map"


def test_launch_file_starts_the_map_and_the_odometry():
    tree = ast.parse((EXAMPLES / "nav2.launch.py").read_text("utf-8"))
    assert [each.name for each in tree.body if isinstance(each, ast.FunctionDef)] == ["generate_launch_description"]
    words = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    assert {"--odometry", "map_server", "lifecycle_manager", "nav2.yaml", "nav2.rviz"} <= words
