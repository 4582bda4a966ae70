"""Files of poses from other programs: columns, units of time, doubtful rows, KITTI, transforms and paths."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ertis_numba import read_trajectory
from ertis_numba.base.errors import ArgumentError, DataError, PoseWarning

pytestmark = pytest.mark.filterwarnings(
    "ignore::ertis_numba.PoseWarning"
)  # These tests examine notes, which say the same.

TIME_NS = 1_700_000_000_123_456_789
START = "1.0 0 0 0 0 0 0 1"
END = "2.0 1 0 0 0 0 0 1"


IDENTITY_ROW = "0 0 0 1"
EUROC = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], b_w_RS_S_x [rad s^-1]\n"
    "1403715524907143168,1,2,3,0.8,0,0,0.6,9,9\n1403715524912143104,1,2,3,0.8,0,0,0.6,9,9\n"
)
TURNED = (0.0, 0.0, 0.6, 0.8)


def written(tmp_path, name, text, encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize(
    ("name", "text", "encoding"),
    [
        ("euroc.csv", EUROC, "utf-8"),
        ("euroc.txt", EUROC, "utf-8"),
        ("windows.csv", EUROC.replace("\n", "\r\n"), "utf-8-sig"),
        ("powershell.csv", EUROC, "utf-16"),
        ("named.csv", "timestamp,tx,ty,tz,qx,qy,qz,qw\n1403715524907143168,1,2,3,0,0,0.6,0.8\n", "utf-8"),
        ("w_first.txt", "# time x y z qw qx qy qz\n1403715524.907143168 1 2 3 0.8 0 0 0.6\n", "utf-8"),
        ("bare_header.tum", "timestamp tx ty tz qx qy qz qw\n1403715524.907143168 1 2 3 0 0 .6 .8\n", "utf-8"),
        ("extra.tum", "# timestamp tx ty tz qx qy qz qw n\n1403715524.907143168 1 2 3 0 0 .6 .8 7\n", "utf-8"),
        ("commas.tum", "1403715524.907143168, 1, 2, 3, 0, 0, 0.6, 0.8\n", "utf-8"),
        ("tabs.tum", "# ground truth\n\n1403715524.907143168\t1\t2\t3\t0\t0\t0.6\t0.8\n", "utf-8"),
        ("german.csv", "time_s;x_m;y_m;z_m;qx;qy;qz;qw\n1403715524,907143168;1;2;3;0;0;0,6;0,8\n", "utf-8"),
        ("nanoseconds.tum", "1403715524907143168 1 2 3 0 0 0.6 0.8\n", "utf-8"),
        ("microseconds.csv", "time_us,x_m,y_m,z_m,qx,qy,qz,qw\n1403715524907143.168,1,2,3,0,0,0.6,0.8\n", "utf-8"),
        ("seconds.csv", "t [seconds],x,y,z,qx,qy,qz,qw\n1403715524.907143168,1,2,3,0,0,0.6,0.8\n", "utf-8"),
        ("comma.tum", "1403715524,907143168 1 2,0 3,0 0 0 0,6 0,8\n", "utf-8"),
        ("ends.tum", "1403715524.907143168,1,2,3,0,0,0.6,0.8,\n", "utf-8"),
        ("spaced.txt", "#timestamp [ns] x [m] y [m] z [m] qw qx qy qz\n1403715524907143168 1 2 3 .8 0 0 .6\n", "utf-8"),
        ("slashes.txt", "// t x y z qw qx qy qz\n// start\n1403715524.907143168 1 2 3 .8 0 0 .6\n", "utf-8"),
        ("exponents.tum", "1.403715524907143168e+09 1.0e0 2.0e0 3.0e0 0 0 6e-1 8e-1\n", "utf-8"),
        (
            "named_units.csv",
            '"t [ms]","x [m]","y [m]","z [m]","q_x","q_y","q_z","q_w"\n1403715524907.143168,1,2,3,0,0,.6,.8',
            "utf-8",
        ),
        (
            "dots.csv",
            (
                "timestamp,position.x [m],position.y [m],position.z [m],rot_x,rot_y,rot_z,rot_w\n"
                "1403715524907143168,1,2,3,0,0,0.6,0.8\n"
            ),
            "utf-8",
        ),
    ],
)
def test_files_of_many_programs_have_the_same_pose(tmp_path, name, text, encoding):
    read = read_trajectory(written(tmp_path, name, text, encoding))
    assert read.time_ns[0] == 1_403_715_524_907_143_168
    assert read.position_m[0].tolist() == [1.0, 2.0, 3.0]
    assert read.rotation_xyzw[0] == pytest.approx(TURNED)


@pytest.mark.parametrize(
    ("first", "second", "unit", "wanted_ns", "note"),
    [
        ("1700000000", "1700000000.1", None, 1_700_000_000_100_000_000, None),
        ("1700000000000", "1700000000100", None, 1_700_000_000_100_000_000, "read as milliseconds since 1970"),
        ("1700000000000000", "1700000000100000", None, 1_700_000_000_100_000_000, "read as microseconds since 1970"),
        ("1700000000000000000", "1700000000100000001", None, 1_700_000_000_100_000_001, "2023-11-14 22:13:20 UTC"),
        ("0.0", "0.1", None, 100_000_000, None),
        ("0.000000000", "1.000000000", None, 1_000_000_000, None),
        ("0", "100", None, 100_000_000_000, "times from 0 to 100 are read as seconds, 100 s from row to row"),
        ("0", "1", None, 1_000_000_000, "times from 0 to 1 are read as seconds, 1 s from row to row"),
        ("0", "33.3", None, 33_300_000_000, "read as seconds"),
        ("0", "100", "ms", 100_000_000, None),
        ("0", "100000000", "ns", 100_000_000, None),
        ("0", "1e5", "us", 100_000_000, None),
    ],
)
def test_unit_of_times_is_found_or_stated_as_a_note(tmp_path, first, second, unit, wanted_ns, note):
    path = written(tmp_path, "a.tum", f"{first} 0 0 0 {IDENTITY_ROW}\n{second} 1 0 0 {IDENTITY_ROW}\n")
    read = read_trajectory(path, time_unit=unit)
    assert read.time_ns[1] == wanted_ns
    assert len(read.notes) == (note is not None)
    assert (note or "") in "".join(read.notes)


def rows(*cells):
    return "".join(f"{each}\n" for each in cells)


@pytest.mark.parametrize(
    ("text", "n_poses", "note"),
    [
        (rows(START, START, END), 2, "1 line left out because an earlier line has the same time and the same pose"),
        (rows(START, "1.0 0.001 0 0 0 0 0 1", END), 2, "poses up to 0.001 m and 0° apart (line 1 and line 2)"),
        (rows(START, "1.0 0 0 0 0 0 0 -1", END), 2, "the same pose"),
        (
            rows(START, "# lost", "1.1 nan nan nan nan nan nan nan", "1.2 0 0 0 NaN 0 0 1", "1.3 0 0 0 0 0 0 1"),
            2,
            "2 of 4 lines left out because numbers are missing, first line 3",
        ),
        (
            rows("1.0 0 0 0 0 0 0 1.04", "1.5 0 0 0 0 0 0 1.0005"),
            2,
            "quaternions of 1 line were scaled to length 1; the largest deviation is 4.0 % in line 1",
        ),
        (rows("1.0 0 0 0 0 0 0 0.9995", "1.5 0 0 0 0 0 0 1"), 2, None),
    ],
)
def test_rows_that_are_left_out_or_changed_are_noted(tmp_path, text, n_poses, note):
    read = read_trajectory(written(tmp_path, "a.tum", text))
    assert len(read) == n_poses
    noted = [each for each in read.notes if "read as seconds" not in each]
    assert [note in each for each in noted] == ([] if note is None else [True])
    assert np.linalg.norm(read.rotation_xyzw, axis=1) == pytest.approx(1.0, abs=1e-12)
    assert read.at([int(read.time_ns[0])]).notes == ()


def test_empty_cells_of_tables_are_rows_without_a_pose(tmp_path):
    text = "time_s,x_m,y_m,yaw_deg\n1.0,0,0,0\n1.1,,,\n1.15,-nan(ind),NULL,NA\n1.2,1,0,90\n"
    read = read_trajectory(written(tmp_path, "a.csv", text))
    assert read.position_m[:, 0].tolist() == [0.0, 1.0]
    assert read.notes == ("2 of 4 lines left out because numbers are missing, first line 3",)


def test_gaps_between_poses_are_noted(tmp_path):
    text = "".join(f"{1.0 + 0.1 * number + 30 * (number >= 5)} 0 0 0 0 0 0 1\n" for number in range(9))
    read = read_trajectory(written(tmp_path, "a.tum", text))
    assert read.notes == (
        "1 gap of more than 1 s between poses, bridged by interpolation; the longest lasts 30.1 s after line 5",
    )
    steady = "".join(f"{2.5 * number} 0 0 0 0 0 0 1\n" for number in range(9))
    assert read_trajectory(written(tmp_path, "b.tum", steady)).notes == ()


KITTI = "1 0 0 0 0 1 0 0 0 0 1 0\n0 0 1 1 0 1 0 0 -1 0 0 2\n"


def test_poses_of_kitti_are_read_with_their_times(tmp_path):
    path, times = written(tmp_path, "00.txt", KITTI), written(tmp_path, "times.txt", "0.0e+00\n1.037359e-01\n")
    read = read_trajectory(path, times=times)
    assert read.time_ns.tolist() == [0, 103_735_900]
    assert read.position_m.tolist() == [[0, 0, 0], [1, 0, 2]]
    assert read.rotation_xyzw[1] == pytest.approx([0, np.sqrt(0.5), 0, np.sqrt(0.5)])
    level = read_trajectory(path, times=times, pose_axes="camera-world")
    assert level.position_m.tolist() == [[0, 0, 0], [2, -1, 0]]
    assert level.rotation_xyzw[1] == pytest.approx([0, 0, -np.sqrt(0.5), np.sqrt(0.5)])


@pytest.mark.parametrize(
    ("text", "times", "message"),
    [
        (KITTI, None, r"as poses of KITTI do, but no times; add the file of their times \(times\)"),
        (KITTI, "0\n", r"there are 2 poses, but 1 times; choose the times of the same drive"),
        (KITTI + "1 0 0 0\n", "0\n1\n2\n", r"line 3 has 4 fields; write 12, as in the first line"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "0\n", r"line 1: the matrix is not a rotation"),
        ("1 0 0 0 0 0 0 1\n", "0\n", r"is for poses of KITTI, with 12 fields in a row, but the rows have 8; remove"),
    ],
)
def test_poses_of_kitti_that_do_not_fit_are_refused(tmp_path, text, times, message):
    path = written(tmp_path, "00.txt", text)
    with pytest.raises(DataError, match=message):
        read_trajectory(path, times=times and written(tmp_path, "times.txt", times))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.tum", rows(START, "1 5 0 0 0 0 0 1"), r"line 1 and line 2 have the same time, but poses 5 m and 0° apart"),
        ("a.tum", rows(START, "1 0 0 0 0 0 1 0"), r"line 1 and line 2 have the same time, but poses 0 m and 180°"),
        (
            "a.tum",
            rows("2 0 0 0 0 0 0 1", "# here", "1.5 0 0 0 0 0 0 1"),
            r"line 3 is 0.5 s before the line before; sort the lines",
        ),
        (
            "a.tum",
            rows(START, "2 0 0 0 0 0 0 1.06"),
            r"line 2: rotation_xyzw has length 1.06 .* correct or remove 1 line",
        ),
        ("a.tum", rows(START, "2 0 0 0 0 0 0 0"), r"line 2: rotation_xyzw has length 0 \(0 0 0 0\)"),
        (
            "a.csv",
            "1700000000,0,0,0,1,0,0,0\n",
            r"first line has numbers instead of names of columns; add a line such as",
        ),
        ("a.csv", "time [min],x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n", r"'time \[min\]' is not in s, ms, us or ns"),
        ("a.txt", "0.0\n0.1\n", r"line 1 has one number, as in the times of KITTI; choose the file of the poses"),
        ("a.tum", rows("1 nan 0 0 0 0 0 1"), r"the file contains no complete pose; 1 of 1 line left out"),
        ("a.tum", rows(START, "2 0 inf 0 0 0 0 1"), r"line 2 has position_m 0 inf 0"),
        ("a.tum", rows("50000000000 0 0 0 0 0 0 1"), r"choose their unit \(time_unit\): s, ms, us, ns"),
        ("a.tum", rows("1 0 0 0 0 0 0 1 5"), r"line 1 has 9 fields; write 8: .* or name all columns in the first line"),
        (
            "a.txt",
            "1403715524907143168,1,2,3,0.8,0,0,0.6\n",
            r"the order of the quaternion in line 1 is unclear: .* or w x y z as in EuRoC",
        ),
        (
            "a.csv",
            "1,2,3,4,5,6,7,8\n",
            r"the first line has numbers instead of names of columns; add a line such as time_s",
        ),
        (
            "a.csv",
            "id,x,y,z,qx,qy,qz,qw\n1,1,2,3,0,0,0,1\n",
            r"columns id, x, y.*; they must be time_ns or time_s \(or",
        ),
        (
            "a.csv",
            "t,x [mm],y [mm],z [mm],qx,qy,qz,qw\n1,1,2,3,0,0,0,1\n",
            r"column 'x \[mm\]' is not in metres; convert the column, and name it x_m",
        ),
        (
            "a.csv",
            "t,tx [mm],ty [mm],qx,qy,qz,qw\n1,1,2,0,0,0,1\n",
            r"column 'tx \[mm\]' is not in metres; convert the column, and name it x_m",
        ),
        (
            "a.csv",
            "#timestamp [ns],w_RS_S_x [rad s^-1],a_RS_S_x [m s^-2]\n1,2,3\n",
            r"contains measurements of an IMU instead of poses; choose .*state_groundtruth",
        ),
        (
            "a.csv",
            "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]\n1403636858601666560,4.6,-1.7,0.8\n",
            r"line 1 names the columns timestamp \[ns\], p_RS_R_x .* but none contains a rotation; add qx, qy, qz, qw",
        ),
        (
            "a.tum",
            rows(*(f"{k // 5}.0 0.0{k} 0 0 0 0 0 1" for k in range(10))),
            r"8 of 10 lines repeat the time of an earlier line with another pose; write the times with all digits",
        ),
        ("a.csv", "#timestamp [ns],filename\n1,1.png\n", r"contains measurements of a camera instead of poses"),
        (
            "a.csv",
            "time_s,x_m,y_m,yaw_deg\n1700000000000,0,0,0\n",
            r"line 2: time 1700000000000 in seconds is beyond the year 2116",
        ),
    ],
)
def test_doubtful_rows_are_refused_with_their_lines(tmp_path, name, text, message):
    path = written(tmp_path, name, text)
    with pytest.raises(DataError, match=f"^{re.escape(str(path))}: .*{message}"):
        read_trajectory(path)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        (b"#ROSBAG V2.0\n", r"is a bag of ROS 1; convert it with .*rosbags-convert --src \"\S+a b.bag\" --dst BAG"),
        (b"SQLite format 3\0", r"is a bag of ROS 2 in SQLite; convert it with"),
        (b"\x89HDF\r\n\x1a\n", r"if it is a recording, write its poses with 'ertis export \"\S+a b.bag\" -o"),
        (b"PK\x03\x04", r"is an archive or a spreadsheet; unpack it or save it as CSV"),
    ],
)
def test_other_formats_are_refused_by_name(tmp_path, start, message):
    path = tmp_path / "a b.bag"
    path.write_bytes(start + bytes(range(256)))
    with pytest.raises(DataError, match=message):
        read_trajectory(path)


@pytest.mark.parametrize(("text", "markup"), [('{"poses": []}\n', "JSON"), ("<gpx/>\n", "XML")])
def test_markup_is_refused_by_name(tmp_path, text, markup):
    with pytest.raises(DataError, match=rf"is {markup}, not a table; choose a \.tum"):
        read_trajectory(written(tmp_path, "a.tum", text))


def test_folder_of_a_bag_is_refused_by_name(tmp_path):
    (tmp_path / "metadata.yaml").touch()
    with pytest.raises(DataError, match=r"is the folder of a bag of ROS 2; use the .mcap file in this folder"):
        read_trajectory(tmp_path)


def test_options_that_do_not_fit_are_refused(tmp_path):
    path = written(tmp_path, "a.csv", "time_s,x_m,y_m,yaw_deg\n1,0,0,0\n")
    with pytest.raises(ArgumentError, match="time_unit 'h' is unknown"):
        read_trajectory(path, time_unit="h")
    with pytest.raises(ArgumentError, match="pose_axes 'rover' is unknown"):
        read_trajectory(path, pose_axes="rover")
    with pytest.raises(DataError, match="states that its times are in s, but time_unit is ms; remove time_unit"):
        read_trajectory(path, time_unit="ms")
    with pytest.raises(
        DataError, match=r"none.txt cannot be read \(No such file or directory\); choose an existing file"
    ):
        read_trajectory(path, times=tmp_path / "none.txt")
    with pytest.raises(
        ArgumentError,
        match=r"time_unit applies to text, but messages in .*a.mcap contain times; remove time_unit",
    ):
        read_trajectory(tmp_path / "a.mcap", time_unit="ms")


def bag(path, topics):
    """Write messages of ROS 2: a dict of topic to (type, definition, list of messages)."""
    writers = pytest.importorskip("mcap_ros2.writer")
    shared = (
        "\n================\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        "================\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
        "================\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
        "================\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
        "================\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\n"
        "geometry_msgs/Quaternion orientation\n"
        "================\nMSG: geometry_msgs/PoseStamped\nstd_msgs/Header header\ngeometry_msgs/Pose pose\n"
        "================\nMSG: geometry_msgs/Transform\ngeometry_msgs/Point translation\n"
        "geometry_msgs/Quaternion rotation\n"
        "================\nMSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/Transform transform\n"
    )
    with path.open("wb") as file:
        writer = writers.Writer(file)
        for topic, (kind, definition, messages) in topics.items():
            schema = writer.register_msgdef(kind, definition + shared)
            for number, message in enumerate(messages):
                writer.write_message(topic, schema, message, log_time=TIME_NS + number, publish_time=TIME_NS + number)
        writer.finish()
    return path


def header(time_ns, frame="map"):
    sec, nanosec = divmod(time_ns, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def place(x_m):
    return {"x": x_m, "y": 2.0, "z": 3.0}, {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}


def stamped(time_ns, x_m, frame="map"):
    position, orientation = place(x_m)
    return {"header": header(time_ns, frame), "pose": {"position": position, "orientation": orientation}}


def transform(time_ns, x_m, parent, child):
    translation, rotation = place(x_m)
    return {
        "header": header(time_ns, parent),
        "child_frame_id": child,
        "transform": {"translation": translation, "rotation": rotation},
    }


STAMPED = ("geometry_msgs/msg/PoseStamped", "std_msgs/Header header\ngeometry_msgs/Pose pose")
PATH = ("nav_msgs/msg/Path", "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses")
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms")


def test_last_message_of_a_path_has_the_poses(tmp_path):
    poses = [stamped(TIME_NS + number, float(number)) for number in range(3)]
    messages = [{"header": header(TIME_NS), "poses": poses[:count]} for count in (1, 2, 3)]
    read = read_trajectory(bag(tmp_path / "a.mcap", {"/path": (*PATH, messages)}))
    assert read.position_m[:, 0].tolist() == [0.0, 1.0, 2.0]


def test_transforms_are_read_by_their_frames(tmp_path):
    messages = [
        {
            "transforms": [
                transform(TIME_NS + number, float(number), "odom", "base_link"),
                transform(TIME_NS + number, 50.0, "base_link", "camera"),
            ]
        }
        for number in range(3)
    ]
    path = bag(tmp_path / "a.mcap", {"/tf": (*TRANSFORMS, messages)})
    assert read_trajectory(path, topic="/tf:odom.base_link").position_m[:, 0].tolist() == [0.0, 1.0, 2.0]
    choices = "choose a transform (topic): /tf:base_link.camera, /tf:odom.base_link"
    for topic in (None, "/tf"):
        with pytest.raises(ArgumentError, match=re.escape(choices)):
            read_trajectory(path, topic=topic)
    with pytest.raises(
        ArgumentError, match=r"contains no transform 'map.base_link'; choose one of base_link.camera, odom"
    ):
        read_trajectory(path, topic="/tf:map.base_link")


def test_frames_and_times_of_messages_are_checked(tmp_path):
    two = [stamped(TIME_NS, 0.0, "map"), stamped(TIME_NS + 1, 0.0, "odom")]
    with pytest.raises(DataError, match=r"poses are in several frames \(a platform in 'map', a platform in 'odom'\)"):
        read_trajectory(bag(tmp_path / "two.mcap", {"/pose": (*STAMPED, two)}))
    late = [stamped(TIME_NS + 5, 0.0), stamped(TIME_NS, 0.0)]
    with pytest.raises(DataError, match=r"message 2 is 5e-09 s before the message before; sort the messages"):
        read_trajectory(bag(tmp_path / "late.mcap", {"/pose": (*STAMPED, late)}))
    zero = [stamped(0, 0.0), stamped(0, 1.0)]
    read = read_trajectory(bag(tmp_path / "zero.mcap", {"/pose": (*STAMPED, zero)}))
    assert read.time_ns.tolist() == [TIME_NS, TIME_NS + 1]
    assert read.notes == ("the messages contain no times (0), so the times at which they were recorded are used",)
    empty = bag(tmp_path / "empty.mcap", {"/path": (*PATH, [{"header": header(TIME_NS), "poses": []}])})
    with pytest.raises(DataError, match="the topic contains no poses; choose another topic"):
        read_trajectory(empty)
    with pytest.raises(ArgumentError, match=r"topic '/path' contains poses instead of transforms; remove ':a.b'"):
        read_trajectory(empty, topic="/path:a.b")


def test_frame_of_another_part_of_the_platform_is_noted(tmp_path):
    messages = [{"transforms": [transform(TIME_NS, 0.0, "odom", "lidar")]}]
    read = read_trajectory(bag(tmp_path / "a.mcap", {"/tf": (*TRANSFORMS, messages)}), topic="/tf:odom.lidar")
    assert read.notes == (
        "poses are those of the frame 'lidar'; the mountings of sensors must be relative to this frame",
    )


LEVEL = "time_s,x_m,y_m,z_m,{}\n1.0,0,0,0,{}\n1.1,1,0,0,{}\n"


@pytest.mark.parametrize(
    ("names", "cells", "angles_deg"),
    [
        ("yaw_deg", "90", (90.0, 0.0, 0.0)),
        ("yaw_rad", "1.5707963267948966", (90.0, 0.0, 0.0)),
        ("yaw [rad]", "-0.5", (-28.64788975654116, 0.0, 0.0)),
        ("roll_deg,pitch_deg,yaw_deg", "10,-20,100", (100.0, -20.0, 10.0)),
        ("yaw_rad,roll_rad", "0.5,0.1", (28.64788975654116, 0.0, 5.729577951308232)),
        ("qw,qx,qy,qz,heading_deg", "0.8,0,0,0.6,7", (73.73979529168804, 0.0, 0.0)),
    ],
)
def test_angles_of_tables_turn_about_fixed_axes_as_in_ros(tmp_path, names, cells, angles_deg):
    read = read_trajectory(written(tmp_path, "a.csv", LEVEL.format(names, cells, cells)))
    wanted = Rotation.from_euler("ZYX", angles_deg, degrees=True)
    assert (Rotation.from_quat(read.rotation_xyzw) * wanted.inv()).magnitude() == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (LEVEL.format("yaw", "1", "1"), "yaw, but yaw are unknown; use time_ns .* yaw_deg or yaw_rad"),
        (LEVEL.format("yaw_deg,pitch", "1,40", "1,40"), "pitch, but pitch are unknown; use time_ns"),
        ("time_s,x_m,y_m,z_mm,yaw_deg\n1,0,0,400,0\n", "yaw_deg, but z_mm are unknown; use time_ns"),
        ("time_s,x_m,y_m,altitude,yaw_deg\n1,0,0,400,0\n", "yaw_deg, but altitude are unknown; use time_ns"),
        (LEVEL.format("yaw_rad", "0", "-90"), "yaw in radians reaches 90; if it is in degrees, name it yaw_deg"),
        (LEVEL.replace("1.1", "1_1").format("yaw_deg", "0", "0"), "line 3: time '1_1' is not a number"),
        (LEVEL.replace("1,0,0,{}\n", "1_0,0,0,{}\n").format("yaw_deg", "0", "0"), "line 3: '1_0' is not a number"),
        (
            LEVEL.replace("1.0", "nan").replace("1.1", "").format("yaw_deg", "0", "0"),
            "there are no poses; 2 lines of 2",
        ),
        (
            "time,x,y,yaw_deg\n2023-02-30T00:00:00,0,0,0\n",
            "line 2: '2023-02-30T00:00:00' is not a date; use dates as",
        ),
        ("time,x,y,yaw_deg\n2023-02-20T00:00:00,0,0,0\n7,0,0,0\n", "line 3: '7' is not a date"),
    ],
)
def test_columns_that_would_be_ignored_and_cells_that_are_no_numbers_are_refused(tmp_path, text, match):
    with pytest.raises(DataError, match=match):
        read_trajectory(written(tmp_path, "a.csv", text))


@pytest.mark.parametrize(
    ("date", "time_ns", "has_note"),
    [
        ("2023-11-14T22:13:20Z", 1_700_000_000_000_000_000, False),
        ("2023-11-14T22:13:20.123456789Z", 1_700_000_000_123_456_789, False),
        ("2023-11-15 00:13:20.5+02:00", 1_700_000_000_500_000_000, False),
        ("2023-11-14 22:13:20", 1_700_000_000_000_000_000, True),
        ("1969-12-31T23:59:59.5Z", -500_000_000, False),
    ],
)
def test_dates_are_times(tmp_path, date, time_ns, has_note):
    read = read_trajectory(written(tmp_path, "a.csv", f"time,x,y,yaw_deg\n{date},1,2,0\n"))
    assert (read.time_ns.tolist(), read.position_m.tolist()) == ([time_ns], [[1.0, 2.0, 0.0]])
    [*zone, unit] = read.notes
    assert unit == "columns of positions state no unit and are read as metres; name them x_m, y_m and z_m"
    assert [each.startswith("dates without a time zone read as UTC") for each in zone] == [True] * has_note


def test_rows_without_a_time_are_left_out(tmp_path):
    text = rows(START, "nan nan nan nan nan nan nan nan", END)
    read = read_trajectory(written(tmp_path, "a.tum", text))
    assert (len(read), read.notes) == (2, ("1 line of 3 without a time (NaN) left out, the first is line 2",))


@pytest.mark.parametrize("start_ns", [0, 4_321 * 10**9])
def test_times_since_a_start_in_nanoseconds_are_doubtful(tmp_path, start_ns):
    text = rows(*(f"{start_ns + 10**8 * number}.0 0 0 0 0 0 0 1" for number in range(20)))
    [note] = read_trajectory(written(tmp_path, "a.tum", text)).notes
    assert note.endswith("if they have another unit, choose it (time_unit)")
    assert read_trajectory(tmp_path / "a.tum", time_unit="ns").time_ns[1] - start_ns == 10**8


@pytest.mark.filterwarnings("default::ertis_numba.PoseWarning")
def test_notes_are_warnings_as_well(tmp_path):
    path = written(tmp_path, "a.tum", rows(START, START, END))
    with pytest.warns(PoseWarning, match=r"a\.tum: 1 line left out"):
        read_trajectory(path)
