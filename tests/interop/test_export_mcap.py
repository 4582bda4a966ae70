"""MCAP files as rosbags reads them; rosbags shares no code with the writer."""

import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosReliability
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ertis_numba.analysis.nearest_echo import nearest_echo
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import PointCloud, Stamp
from ertis_numba.geometry import Grid, direction_grid, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.interop import TOPICS, export
from ertis_numba.interop.ros_definitions import DEFINITIONS, schema
from ertis_numba.settings import Processing, Settings
from tests.files import SMALL, image, with_echoes

TIME_NS = 1_700_000_000_123_456_789
MOUNTING = {"eRTIS-7": ((1.0, -2.0, 0.5), (0.0, 0.0, 0.6, 0.8)), "2.right": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}


def spatial(seed=1):
    """An image with elevations."""
    grid = direction_grid(Processing(directions="3d:60"))
    return image(*np.degrees([grid.azimuth_rad, grid.elevation_rad]), range_m=np.linspace(0.5, 1.5, 50), seed=seed)


def stamped(given, sensor, sequence, time_ns):
    return given.replace(stamp=Stamp(sensor=sensor, sequence=sequence, timestamp_ns=time_ns))


GIVEN = [
    stamped(with_echoes(image(seed=1)), "eRTIS-7", 10, TIME_NS),
    stamped(with_echoes(image(seed=2)), "eRTIS-7", 2**40 + 11, TIME_NS + 50_000_000),
    stamped(with_echoes(spatial()), "2.right", 10, TIME_NS + 1),
]
KINDS = {
    "points": "sensor_msgs/msg/PointCloud2",
    "scan": "sensor_msgs/msg/LaserScan",
    "image": "sensor_msgs/msg/Image",
    "sonar_image": "marine_acoustic_msgs/msg/ProjectedSonarImage",
}
FRAMES = {"eRTIS-7": "/eRTIS_7", "2.right": "/sensor_2_right"}


def read(path):
    """Content as rosbags reads it: messages by (topic, time), and the profiles of the topics."""
    messages, profiles, kinds = {}, {}, {}
    with AnyReader([path]) as reader:
        for connection in reader.connections:
            profiles[connection.topic] = connection.ext.offered_qos_profiles
            kinds[connection.topic] = connection.msgtype
        for connection, time_ns, raw in reader.messages():
            messages[connection.topic, time_ns] = reader.deserialize(raw, connection.msgtype)
    return messages, profiles, kinds


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    (path,) = export(tmp_path_factory.mktemp("bag") / "a.mcap", GIVEN, mounting=MOUNTING, top=40, min_level_db=-60.0)
    return read(path)


def reported(message):
    """Message as dicts, lists and numbers."""
    if hasattr(message, "__msgtype__"):
        return {
            name: reported(value) for name, value in vars(message).items() if name.islower() and name != "__msgtype__"
        }
    if isinstance(message, np.ndarray):
        return message.tolist()
    return [reported(item) for item in message] if isinstance(message, list) else message


def header(given, frame):
    sec, nanosec = divmod(given.stamp.timestamp_ns, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def test_mcap_has_the_documented_topics(bag):
    messages, profiles, kinds = bag
    assert tuple(KINDS) == TOPICS
    planar = {each.stamp.sensor for each in GIVEN if each.is_planar}  # The other images have no scans.
    topics = {sensor: [each for each in TOPICS if each != "scan" or sensor in planar] for sensor in FRAMES}
    wanted = {f"{base}/{topic}": KINDS[topic] for sensor, base in FRAMES.items() for topic in topics[sensor]}
    assert kinds == wanted | {"/tf_static": "tf2_msgs/msg/TFMessage"}
    times = {
        (f"{FRAMES[each.stamp.sensor]}/{topic}", each.stamp.timestamp_ns)
        for each in GIVEN
        for topic in topics[each.stamp.sensor]
    }
    assert set(messages) == times | {("/tf_static", TIME_NS)}
    for topic, (profile,) in profiles.items():
        static = topic == "/tf_static"
        assert isinstance(profile, Qos)
        assert profile.durability is (QosDurability.TRANSIENT_LOCAL if static else QosDurability.VOLATILE)
        assert (profile.history, profile.depth) == (QosHistory.KEEP_LAST, 1 if static else 10)
        assert profile.reliability is QosReliability.RELIABLE
        assert profile.lifespan == profile.deadline == (9_223_372_036, 854_775_807)  # RMW_DURATION_INFINITE


@pytest.mark.parametrize("given", GIVEN, ids=["first", "second", "spatial"])
def test_mcap_points_come_back(bag, given):
    sensor = given.stamp.sensor
    message = bag[0][f"{FRAMES[sensor]}/points", given.stamp.timestamp_ns]
    grid = Grid(given.azimuth_rad, given.elevation_rad)
    cloud = PointExtractor(given.settings, grid, top=40, min_level_db=-60.0)(given)
    assert len(cloud) > 1
    rows = np.column_stack([cloud.position_m, 20 * np.log10(cloud.amplitude), cloud.uncertainty_m])
    assert reported(message) == {
        "header": header(given, sensor),
        "height": 1,
        "width": len(cloud),
        "fields": [
            {"name": name, "offset": 4 * number, "datatype": 7, "count": 1}
            for number, name in enumerate(["x", "y", "z", "intensity", "uncertainty_range", "uncertainty_across"])
        ],
        "is_bigendian": False,
        "point_step": 24,
        "row_step": 24 * len(cloud),
        "data": list(rows.astype("<f4").tobytes()),
        "is_dense": True,
    }


@pytest.mark.parametrize("given", GIVEN[:2], ids=["first", "second"])
def test_mcap_scan_has_the_nearest_echo_of_each_azimuth(bag, given):
    sensor = given.stamp.sensor
    scan = bag[0][f"{FRAMES[sensor]}/scan", given.stamp.timestamp_ns]
    order = np.argsort(given.azimuth_rad)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    assert_allclose(angles, given.azimuth_rad[order], atol=1e-6)  # The angles of this grid are evenly spaced.
    range_m, level_dbfs = nearest_echo(given)
    assert np.isfinite(range_m).any()
    assert np.array_equal(scan.ranges, range_m[order].astype(np.float32))
    assert np.array_equal(scan.intensities, level_dbfs[order])
    assert (scan.range_min, scan.range_max) == (np.float32(given.range_m[0]), np.float32(given.range_m[-1]))


@pytest.mark.parametrize("given", GIVEN, ids=["first", "second", "spatial"])
def test_mcap_sonar_image_comes_back(bag, given):
    sensor = given.stamp.sensor
    message = bag[0][f"{FRAMES[sensor]}/sonar_image", given.stamp.timestamp_ns]
    amplitudes = message.image.data.view("<f4").reshape(len(given.range_m), len(given.azimuth_rad))
    assert np.array_equal(amplitudes, given.amplitude.T)
    assert np.array_equal(message.ranges, given.range_m.astype(np.float32))
    # The frame is z forward, x up, y right; that of the sensor x forward, y left, z up.
    forward, left, up = unit_vectors(given.azimuth_rad, given.elevation_rad).T
    beams = [[beam.x, beam.y, beam.z] for beam in message.beam_directions]
    assert np.array_equal(beams, np.column_stack([up, -left, forward]))
    rest = reported(message)
    for name in ("beam_directions", "ranges"):
        rest.pop(name)
    rest["image"].pop("data")
    assert rest == {
        "header": header(given, f"{sensor}_sonar"),
        "ping_info": {
            "frequency": 37_500.0,
            "sound_speed": float(np.float32(sound_speed_m_s(given.settings.air))),
            "tx_beamwidths": [],
            "rx_beamwidths": [],
        },
        "image": {"is_bigendian": False, "dtype": 8, "beam_count": len(given.azimuth_rad)},
    }


def test_mcap_pictures_show_the_image(bag):
    """A planar image has columns from the left and rows from the far end; a spatial one has its maximum in place."""
    messages, _, _ = bag
    planar = messages["/eRTIS_7/image", TIME_NS]
    given = GIVEN[0]
    assert (planar.height, planar.width, planar.step) == (400, 37, 37)
    assert (planar.encoding, planar.is_bigendian) == ("mono8", 0)
    assert reported(planar.header) == header(given, "eRTIS-7")
    pixels = planar.data.reshape(400, 37)
    level_db = 20 * np.log10(given.amplitude / given.amplitude.max())
    wanted = np.rint(255 * np.clip(1 + level_db / 40, 0, 1)).T[::-1, ::-1]
    assert np.abs(pixels - wanted).max() <= 1
    assert pixels.max() == 255
    skewed = given.amplitude.copy()
    skewed[5, 30] = 1.0  # to the right of the middle and near
    assert given.azimuth_rad[5] < 0
    row, column = np.unravel_index(_pixels(given.replace(amplitude=skewed)).argmax(), (400, 37))
    assert (row, column) == (400 - 1 - 30, 37 - 1 - 5)


def _pixels(given):
    from ertis_numba.interop._grey_image import GreyImage  # noqa: PLC0415  as the file has it

    return GreyImage(given)(given.amplitude)


@pytest.mark.parametrize("direction", [0, 17, 33, 59])
def test_mcap_map_of_directions_is_correct(direction):
    given = spatial()
    amplitude = np.full_like(given.amplitude, 0.001)
    amplitude[direction, 20] = 1.0
    pixels = _pixels(given.replace(amplitude=amplitude))
    rows, columns = np.nonzero(pixels == 255)
    height, width = pixels.shape
    azimuth_rad = np.interp(columns.mean(), [0, width - 1], [given.azimuth_rad.max(), given.azimuth_rad.min()])
    elevation_rad = np.interp(rows.mean(), [0, height - 1], [given.elevation_rad.max(), given.elevation_rad.min()])
    seen = unit_vectors(np.array(azimuth_rad), np.array(elevation_rad))
    there = unit_vectors(given.azimuth_rad, given.elevation_rad)[direction]
    assert np.degrees(np.arccos(min(1.0, float(seen @ there)))) < 12  # of 18° between directions


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "shape"),
    [([5], [10], (1, 1)), ([-30, 0, 30], [10, 10, 10], (1, 3)), ([0, 0], [-9, 9], (2, 1))],
)
def test_mcap_map_of_few_directions_is_correct(azimuth_deg, elevation_deg, shape):
    pixels = _pixels(image(azimuth_deg, elevation_deg))
    assert pixels.shape == shape
    assert pixels.max() == 255


@pytest.mark.parametrize("azimuth_deg", [np.arange(150, 211, 10), [150, 160, 170, 180, -170, -160, -150]])
def test_leftmost_direction_behind_the_sensor_is_the_first_column(azimuth_deg):
    """It is 210°, for any start of the azimuths."""
    amplitude = np.geomspace(0.1, 1.0, 7, dtype=np.float32)[:, None].repeat(50, axis=1)  # the farther left, the louder
    pixels = _pixels(image(azimuth_deg, range_m=np.linspace(0.5, 1.5, 50)).replace(amplitude=amplitude))
    assert pixels.shape == (50, 7)
    assert (np.diff(pixels[0].astype(int)) < 0).all()


def test_map_behind_the_sensor_equals_the_map_ahead():
    azimuth_deg, elevation_deg = (axis.ravel() for axis in np.meshgrid(np.arange(-30, 31, 5), np.arange(-20, 21, 5)))
    ahead = image(azimuth_deg, elevation_deg)
    behind = image((azimuth_deg + 360) % 360 - 180, elevation_deg)
    wanted = _pixels(ahead)
    assert wanted.shape == (9, 13)
    np.testing.assert_array_equal(_pixels(behind), wanted)


def test_mcap_has_static_transforms(bag):
    message = bag[0]["/tf_static", TIME_NS]
    found = {each.child_frame_id: (each.header.frame_id, reported(each.transform)) for each in message.transforms}
    assert set(found) == {"eRTIS-7", "eRTIS-7_sonar", "2.right", "2.right_sonar"}
    parent, transform = found["eRTIS-7"]
    assert parent == "base_link"
    assert tuple(transform["translation"].values()) == MOUNTING["eRTIS-7"][0]
    assert tuple(transform["rotation"].values()) == MOUNTING["eRTIS-7"][1]
    parent, transform = found["2.right_sonar"]
    assert parent == "2.right"
    assert set(transform["translation"].values()) == {0.0}
    turn = np.array(list(transform["rotation"].values()))
    axis, w = turn[:3], turn[3]
    for beam, sensor in (((0, 0, 1), (1, 0, 0)), ((1, 0, 0), (0, 0, 1)), ((0, 1, 0), (0, -1, 0))):
        turned = beam + 2 * w * np.cross(axis, beam) + 2 * np.cross(axis, np.cross(axis, beam))
        np.testing.assert_allclose(turned, sensor, atol=1e-12)


def test_message_definitions_equal_those_of_ros():
    """Hashes of REP 2016 confirm them; the marine messages are compared by their fields."""
    own, theirs = get_typestore(Stores.EMPTY), get_typestore(Stores.ROS2_JAZZY)
    others = (
        "tf2_msgs/msg/TFMessage",
        "diagnostic_msgs/msg/DiagnosticArray",
        "nav_msgs/msg/OccupancyGrid",
        "rosgraph_msgs/msg/Clock",
        "nav_msgs/msg/Odometry",
    )
    for name in (*others, *KINDS.values()):
        own.register(get_types_from_msg(schema(name), name))
    assert set(own.fielddefs) >= set(DEFINITIONS)
    compared = [name for name in DEFINITIONS if name in theirs.fielddefs]
    assert len(compared) == len(DEFINITIONS) - 3
    for name in compared:
        assert own.hash_rihs01(name) == theirs.hash_rihs01(name)
        assert own.fielddefs[name][0] == theirs.fielddefs[name][0]  # constants, which no hash holds
    constants, fields = own.fielddefs["marine_acoustic_msgs/msg/SonarImageData"]
    kinds = ("UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "UINT64", "INT64", "FLOAT32", "FLOAT64")
    assert [constant[0] for constant in constants] == [f"DTYPE_{kind}" for kind in kinds]
    assert [constant[2] for constant in constants] == list(range(10))
    assert [field[0] for field in fields] == ["is_bigendian", "dtype", "beam_count", "data"]
    _, fields = own.fielddefs["marine_acoustic_msgs/msg/PingInfo"]
    assert [field[0] for field in fields] == ["frequency", "sound_speed", "tx_beamwidths", "rx_beamwidths"]


def test_mcap_metadata_contains_the_settings(tmp_path):
    from mcap.reader import make_reader  # noqa: PLC0415  one test needs it

    (path,) = export(tmp_path / "a.mcap", GIVEN[:1], topics=["points"])
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        (record,) = reader.iter_metadata()
        assert reader.get_header().profile == "ros2"
        assert [message.sequence for _, channel, message in reader.iter_messages("/eRTIS_7/points")] == [10]
    assert (record.name, record.metadata["sensor"]) == ("ertis_numba/eRTIS-7", "eRTIS-7")
    settings = Settings.from_toml(record.metadata["settings"])
    assert settings.replace(array=SMALL.array) == SMALL
    assert [record.metadata[f"n_{name}"] for name in ("active", "passive", "unknown")] == ["0", "0", "1"]
    assert set(read(path)[2]) == {"/eRTIS_7/points", "/tf_static"}  # and no transform, as nobody knows one
    assert read(path)[0]["/tf_static", TIME_NS].transforms == []


def fused_image(places_m, across_m=0.005):
    """A dark image around a platform, with points at places."""
    azimuth_deg = np.arange(360) - 179.5
    made = image(azimuth_deg, np.zeros(360), range_m=np.linspace(0.02, 4.0, 200), seed=3)
    made = stamped(made, "base_link", 3, TIME_NS)
    cloud = PointCloud(
        np.array([[*place, 0.4] for place in places_m], np.float32),
        np.full(len(places_m), 0.1, np.float32),
        made.settings,
        made.stamp,
        uncertainty_m=np.tile(np.float32([0.002, across_m]), (len(places_m), 1)),
    )
    return made.replace(points=cloud)


def test_scans_of_fused_images_have_each_reflector_in_one_beam(tmp_path):
    rng = np.random.default_rng(7)
    for scene in range(24):
        range_m, azimuth_rad = rng.uniform(0.4, 3.8, 6), rng.uniform(-np.pi, np.pi, 6)
        places_m = np.stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad)], axis=1)
        (path,) = export(tmp_path / f"{scene}.mcap", [fused_image(places_m, 0.001)], topics=["scan"])
        scan = read(path)[0]["/fused/scan", TIME_NS]
        angle_rad = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        wanted = np.full(360, np.inf)
        for near_m, toward_rad in sorted(zip(range_m, azimuth_rad, strict=True), reverse=True):
            off = np.cos(angle_rad - toward_rad)
            wanted[off >= np.cos(np.radians(3.48))] = np.inf  # Farther echoes may be those of several reflections.
            wanted[np.argmax(off)] = near_m
        np.testing.assert_allclose(scan.ranges, wanted, atol=1e-4)
        assert scan.header.frame_id == "base_link"


@pytest.mark.parametrize(("across_m", "n_beams"), [(0.005, 1), (0.1, 5), (np.nan, 1)])
def test_scans_show_reflectors_as_wide_as_their_direction_is_uncertain(tmp_path, across_m, n_beams):
    # 0.1 m at 2 m are 2.86°, so that beams at 0°, ±1° and ±2° from the reflector show it.
    middle_rad = np.radians(0.5)
    places_m = [(2 * np.cos(middle_rad), 2 * np.sin(middle_rad))]
    (path,) = export(tmp_path / "wide.mcap", [fused_image(places_m, across_m)], topics=["scan"])
    assert np.count_nonzero(np.isfinite(read(path)[0]["/fused/scan", TIME_NS].ranges)) == n_beams


def test_scans_omit_reflectors_that_are_not_confirmed_unless_they_are_nearest(tmp_path):
    given = fused_image([(2.0, 0.0), (-1.5, 0.0), (0.0, 3.0), (0.0, -1.0)], 0.001)
    for confirmed, ranges_m in (
        ([True, False, True, True], [1.0, 2.0, 3.0]),
        ([True, False, False, False], [1.0, 2.0]),
        ([False, False, False, False], [1.0]),
        (None, [1.0, 1.5, 2.0, 3.0]),
    ):
        flags = None if confirmed is None else np.array(confirmed)
        cloud = given.points.replace(confirmed=flags)
        (path,) = export(tmp_path / "sure.mcap", [given.replace(points=cloud)], topics=["scan"], overwrite=True)
        found_m = np.array(read(path)[0]["/fused/scan", TIME_NS].ranges)
        np.testing.assert_allclose(np.unique(found_m[np.isfinite(found_m)]), ranges_m, atol=1e-4)


def test_mcap_has_no_transform_of_the_platform_to_itself(tmp_path):
    fused = stamped(GIVEN[0], "base_link", 3, TIME_NS)
    mounting = {"base_link": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}
    (path,) = export(tmp_path / "points.mcap", [fused], topics=["points"], mounting=mounting)
    assert set(read(path)[2]) == {"/fused/points"}
    (path,) = export(tmp_path / "all.mcap", [fused], mounting=mounting)
    children = [each.child_frame_id for each in read(path)[0]["/tf_static", TIME_NS].transforms]
    assert children == ["base_link_sonar"]


def test_mcap_export_refuses_invalid_input(tmp_path, monkeypatch):
    given = GIVEN[0]
    for items, options, message in (
        ([], {}, "no energyscape is passed;"),
        ([given], {"topics": ["cloud"]}, "topic 'cloud' is unknown; known are points, scan, image, sonar_image"),
        ([given.replace(stamp=Stamp(timestamp_ns=2**62))], {}, "outside 1970 to 2038"),
        (
            [given.replace(stamp=Stamp(sensor="a b"))],
            {},
            "sensor name 'a b' cannot name a group in a file; use letters",
        ),
    ):
        with pytest.raises(ArgumentError, match=message):
            export(tmp_path / "a.mcap", items, **options)
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(ArgumentError, match=r"needs mcap and mcap-ros2-support .*pip install 'ertis-numba\[ros\]'"):
        export(tmp_path / "a.mcap", [given])
    assert list(tmp_path.iterdir()) == []
