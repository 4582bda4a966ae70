"""Trajectories in files of TUM, CSV and MCAP."""

import re

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ertis_numba import Trajectory, read_trajectory, write_tum
from ertis_numba.base.errors import ArgumentError, DataError

pytestmark = pytest.mark.filterwarnings("ignore::ertis_numba.PoseWarning")  # Random poses are hardly those of a robot.

TIME_NS = 1_700_000_000_123_456_789
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def some_trajectory(seed, n_poses):
    random = np.random.default_rng(seed)
    rotation = random.normal(size=(n_poses, 4))
    return Trajectory(
        TIME_NS + np.cumsum(random.integers(1, 10**10, n_poses)),
        random.normal(size=(n_poses, 3)) * 100,
        rotation / np.linalg.norm(rotation, axis=1)[:, None],
    )


def same(one, other):
    assert one.time_ns.tolist() == other.time_ns.tolist()
    np.testing.assert_allclose(one.position_m, other.position_m, atol=1e-9)
    np.testing.assert_allclose(one.rotation_xyzw, other.rotation_xyzw, atol=1e-11)


@settings(deadline=None)  # files take long on a busy disk
@given(seed=st.integers(0, 1000), n_poses=st.integers(1, 20))
def test_tum_file_holds_the_trajectory(tmp_path_factory, seed, n_poses):
    path = tmp_path_factory.mktemp("tum") / "path.tum"
    trajectory = some_trajectory(seed, n_poses)
    write_tum(path, trajectory)
    read = read_trajectory(path)
    same(read, trajectory)
    assert read.source == "file"


def test_tum_file_has_no_suffix_of_another_format(tmp_path):
    with pytest.raises(ArgumentError, match=r"ends in \.csv, but poses are written as TUM text; choose a name that"):
        write_tum(tmp_path / "path.csv", some_trajectory(1, 2))


def test_tum_file_is_not_replaced_unless_asked(tmp_path):
    path = tmp_path / "path.tum"
    write_tum(path, some_trajectory(1, 2))
    with pytest.raises(ArgumentError, match="exists"):
        write_tum(path, some_trajectory(2, 3))
    write_tum(path, some_trajectory(2, 3), overwrite=True)
    assert len(read_trajectory(path)) == 3


@pytest.mark.parametrize(
    ("text", "position_m", "rotation_xyzw"),
    [
        ("time_s,x_m,y_m,yaw_deg\n# start\n1.5,1,2,90\n", (1, 2, 0), (0, 0, np.sqrt(0.5), np.sqrt(0.5))),
        ('"time_s","x_m","y_m","yaw_deg"\n1.5,1,2,180\n', (1, 2, 0), (0, 0, 1, 0)),
        ("x_m, y_m, z_m, time_ns, qx, qy, qz, qw, note\n1,2,3,1500000000,0,0,1,0,5\n", (1, 2, 3), (0, 0, 1, 0)),
    ],
)
def test_csv_columns_are_read_by_name(tmp_path, text, position_m, rotation_xyzw):
    path = tmp_path / "path.csv"
    path.write_text(text)
    read = read_trajectory(path)
    assert read.time_ns.tolist() == [1_500_000_000]
    np.testing.assert_allclose(read.position_m, [position_m])
    np.testing.assert_allclose(read.rotation_xyzw, [rotation_xyzw], atol=1e-15)


def write_mcap(path, topics):
    """Write messages of ROS 2: a dict of topic to (type of ROS, list of times in nanoseconds)."""
    writers = pytest.importorskip("mcap_ros2.writer")
    definition = (
        "std_msgs/Header header\n{field}\n"
        "================\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        "================\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
        "================\nMSG: geometry_msgs/Pose\n"
        "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
        "================\nMSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n"
        "================\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
        "================\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
    )
    with path.open("wb") as file:
        writer = writers.Writer(file)
        for topic, (kind, times_ns) in topics.items():
            has_covariance = kind != "geometry_msgs/msg/PoseStamped"
            field = f"geometry_msgs/Pose{'WithCovariance' if has_covariance else ''} pose"
            schema = writer.register_msgdef(kind, definition.format(field=field))
            for number, time_ns in enumerate(times_ns):
                pose = {
                    "position": {"x": float(number), "y": 2.0, "z": 3.0},
                    "orientation": {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0},
                }
                sec, nanosec = divmod(time_ns, 10**9)
                message = {
                    "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "map"},
                    "pose": {"pose": pose, "covariance": np.eye(6).ravel().tolist()} if has_covariance else pose,
                }
                writer.write_message(topic, schema, message, log_time=time_ns, publish_time=time_ns)
        writer.finish()


@pytest.mark.parametrize("kind", ["nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"])
def test_mcap_topic_is_read(tmp_path, kind):
    path = tmp_path / "drive.mcap"
    write_mcap(path, {"/pose": (kind, [TIME_NS, TIME_NS + 7]), "/points": ("sensor_msgs/msg/Image", [])})
    read = read_trajectory(path)
    assert read.time_ns.tolist() == [TIME_NS, TIME_NS + 7]
    assert read.position_m.tolist() == [[0.0, 2.0, 3.0], [1.0, 2.0, 3.0]]
    assert read.rotation_xyzw.tolist() == [[0.0, 0.0, 1.0, 0.0]] * 2
    assert (read.covariance is None) == (kind == "geometry_msgs/msg/PoseStamped")


def test_mcap_with_several_topics_needs_a_choice(tmp_path):
    path = tmp_path / "drive.mcap"
    kind = "geometry_msgs/msg/PoseStamped"
    write_mcap(path, {"/one": (kind, [1]), "/two": (kind, [1, 2])})
    with pytest.raises(ArgumentError, match="topics with poses: /one, /two; choose one"):
        read_trajectory(path)
    assert len(read_trajectory(path, topic="/two")) == 2
    with pytest.raises(ArgumentError, match="topic '/three' does not exist"):
        read_trajectory(path, topic="/three")


def as_file(path, content):
    path.write_bytes(content)
    return path


def test_damaged_mcap_is_refused(tmp_path):
    """Cuts and changed bytes make the libraries raise a dozen types of errors."""
    path = tmp_path / "drive.mcap"
    write_mcap(path, {"/pose": ("geometry_msgs/msg/PoseStamped", [TIME_NS + number for number in range(40)])})
    whole = path.read_bytes()
    draws = np.random.default_rng(1)
    for place in draws.integers(0, len(whole), 20):
        path.write_bytes(whole[:place])
        with pytest.raises((ArgumentError, DataError), match=f"^{re.escape(str(path))}: "):
            read_trajectory(path)
    intact = read_trajectory(as_file(path, whole))
    for place in draws.integers(0, len(whole), 60):
        try:
            read = read_trajectory(as_file(path, whole[:place] + bytes([whole[place] ^ 0x15]) + whole[place + 1 :]))
        except (ArgumentError, DataError) as error:
            assert str(error).startswith(f"{path}: ")  # noqa: PT017  a changed byte need not be an error
        else:
            assert [read.time_ns.tolist(), read.position_m.tolist(), read.rotation_xyzw.tolist()] == [
                intact.time_ns.tolist(), intact.position_m.tolist(), intact.rotation_xyzw.tolist()
            ]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.tum", "", "the file contains no poses; choose a file with at least one"),
        ("a.tum", "1 2 3\n", "line 1 has 3 fields; write 8: timestamp tx ty tz qx qy qz qw"),
        ("a.tum", "# first\nx 0 0 0 0 0 0 1\n", "line 2: time 'x' is not a number"),
        ("a.tum", "nan 0 0 0 0 0 0 1\n", "1 line of 1 without a time (NaN) left out"),
        ("a.tum", "1 0 0 z 0 0 0 1\n", "line 1: could not convert string to float: 'z'"),
        ("a.tum", "1 0 0 inf 0 0 0 1\n", "position_m"),
        ("a.tum", "1e30 0 0 0 0 0 0 1\n", "times such as 1e+30 are no dates from 1973 to 2116 in any unit"),
        ("a.tum", "1e999999 0 0 0 0 0 0 1\n", "line 1: time '1e999999' is not a number"),
        ("a.tum", "1 1e300 0 0 0 0 0 1\n", "line 1 has position_m 1e+300 0 0; positions must be in metres, within"),
        ("a.csv", "time_s,x_m,x_m,y_m,yaw_deg\n1,2,2,3,4\n", "each column must occur once, and only one may be a time"),
        (
            "a.csv",
            "time_s,time_ns,x_m,y_m,yaw_deg\n1,1,2,3,4\n",
            "each column must occur once, and only one may be a time",
        ),
        ("a.tum", "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "time_ns does not increase"),
        ("a.tum", "1 0 0 0 0 0 0 2\n", "rotation_xyzw has length 2"),
        ("a.csv", "", "the file contains no line that names its columns; the columns must be time_ns or time_s"),
        ("a.csv", "time_s,x_m,yaw_deg\n", "the first line names the columns time_s, x_m, yaw_deg; they must be"),
        ("a.csv", "time_s,x_m,y_m,yaw_deg\n1,2,3\n", "line 2 has 3 fields; write 4, as in the first line"),
        ("a.csv", "time_s,x_m,y_m,yaw_deg\n", "the file contains no poses"),
        ("a.mcap", "no file of this kind\n", "is a text file, not messages in MCAP; rename it to end in .tum or .csv"),
        ("a.mcap", "short", "has content of an unknown format, not messages in MCAP; choose a .tum"),
        ("a.mcap", "", "is empty, not messages in MCAP; choose a .tum"),
        ("a.tum", "II*\0....", "is a TIFF image; choose a .tum, .txt, .csv or .mcap file"),
    ],
)
def test_unusable_files_are_refused(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    if path.suffix == ".mcap":
        pytest.importorskip("mcap_ros2")
    with pytest.raises(DataError) as error:
        read_trajectory(path)
    assert str(path) in str(error.value)
    assert message in str(error.value)


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(DataError, match="does not exist"):
        read_trajectory(tmp_path / "a.tum")
    with pytest.raises(DataError, match="is a folder"):
        read_trajectory(tmp_path)
    (tmp_path / "b.tum").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(DataError, match="is not a text file"):
        read_trajectory(tmp_path / "b.tum")
    (tmp_path / "c.tum").write_text("1 0 0 0 0 0 0 1\n")
    with pytest.raises(ArgumentError, match=r"is not an .mcap file and has no topics"):
        read_trajectory(tmp_path / "c.tum", topic="/pose")
