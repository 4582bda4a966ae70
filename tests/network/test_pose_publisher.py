"""Poses that applications send: stored with the measurements, authenticated, limited, and refused in one line."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import zmq
from click.testing import CliRunner
from ertis_cli.main import cli
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError, NetworkError, RefusedError
from ertis_numba.journal import SUFFIX, Journal, JournalEntry, JournalPose
from ertis_numba.journal._tables import row_crc32
from ertis_numba.network import messages, sockets
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.central_node import Archive, _recent_poses
from ertis_numba.network.central_node._admission import Unwanted
from ertis_numba.network.central_node._poses import MAX_RATE_HZ, PoseIntake
from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys
from ertis_numba.network.messages import PlatformPose, Refused
from ertis_numba.network.pose_publisher import PosePublisher
from ertis_numba.network.zap_authenticator import EVERYBODY
from ertis_numba.settings import Processing
from ertis_numba.simulation import Electronics, Point, Scene, Sensor
from tests.central import Node, running, stored, wanted
from tests.journals import ENVIRONMENT, entries
from tests.network.test_record import Recording
from tests.pages import ROOT
from tests.ports import reserved_address

IDENTITY = (0.0, 0.0, 0.0, 1.0)
MS_NS = 1_000_000


def drive(begin_ns, end_ns, *, step_ns=20 * MS_NS, source="odometry"):
    """A drive along a bend with covariances, from before the first measurement to after the last one."""
    time_ns = np.append(np.arange(begin_ns, end_ns, step_ns), end_ns)
    elapsed_s = (time_ns - begin_ns)[:, None] / 1e9
    return ertis.Trajectory(
        time_ns,
        elapsed_s * [0.5, 0.1, -0.01],
        Rotation.from_rotvec(elapsed_s * [0.1, 0.2, 0.7]).as_quat(),
        (1 + elapsed_s[:, :, None]) * np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6]),
        source,
    )


def send(publisher, trajectory):
    for row in zip(trajectory.time_ns.tolist(), trajectory.position_m, trajectory.rotation_xyzw, trajectory.covariance,
                   strict=True):  # fmt: skip
        assert publisher.send(*row)
    publisher.flush()


def times_of(given):
    return [entry.measurement.stamp.timestamp_ns for entry in given]


def pose_of(**changes):
    fields = {
        "sensors": ("left",),
        "session_id": 1,
        "timestamp_ns": 5,
        "position_m": (1.0, 2.0, 3.0),
        "rotation_xyzw": IDENTITY,
    }
    return PlatformPose(**fields | changes)


def the_recording(folder):
    (path,) = folder.glob("*.h5")
    return path


def test_recording_has_the_sent_poses_at_its_measurements(tmp_path):
    both = {name: entries(5, sensor=name) for name in ("left", "right")}
    times_ns = times_of(both["left"])
    given = drive(times_ns[0] - 7 * MS_NS, times_ns[-1] + 5 * MS_NS)
    with (
        running(archive=Archive(tmp_path)) as central,
        PosePublisher(central.address, ["left", "right"], source="odometry") as publisher,
        Node(central.address) as node,
    ):
        publisher.flush()
        send(publisher, given)
        for name, measured in both.items():
            node.hello(name)
            node.measure(*measured)
            node.hear_settled(14)
    assert central.latest.archive.poses == len(given)
    wanted = given.at(times_ns)
    for name in both:
        with ertis.open_recording(the_recording(tmp_path), sensor=name) as recording:
            found = recording.trajectory
        assert (found.time_ns.tolist(), found.source, found.max_gap_s) == (times_ns, "odometry", None)
        for part in ("position_m", "rotation_xyzw", "covariance"):
            np.testing.assert_array_equal(getattr(found, part), getattr(wanted, part))
    assert [event["text"] for event in central.events if event["event"] == "sealed"] == [""]


def test_measurements_without_poses_are_stored_and_counted_once(tmp_path):
    """Poses cover the second half of the first second; then they pause for 2 s."""
    measured = entries(60)
    times_ns = times_of(measured)
    poses = drive(times_ns[10], times_ns[20])
    later = drive(times_ns[50], times_ns[55])
    with running(archive=Archive(tmp_path)) as central, Node(central.address) as node:
        with PosePublisher(central.address, ["left"]) as publisher:
            publisher.flush()
            send(publisher, poses)
            send(publisher, later)
        node.hello()
        for entry in measured:
            node.measure(entry)
            node.hear_settled(entry.measurement.stamp.sequence)
    with ertis.open_recording(the_recording(tmp_path)) as recording:
        found = recording.trajectory
        assert len(recording) == 60
    assert found.time_ns.tolist() == times_ns[10:21] + times_ns[50:56]
    assert found.covers(times_ns).tolist() == [10 <= n <= 20 or 50 <= n <= 55 for n in range(60)]
    (text,) = [event["text"] for event in central.events if event["event"] == "sealed"]
    assert text == "43 measurements have no pose, because poses were missing at their times"


@pytest.mark.parametrize("late_s", [60.0, 0.0])
def test_poses_that_arrive_late_belong_to_the_finished_journal(tmp_path, monkeypatch, late_s):
    """The last measurement of a journal lies between two poses, of which the second comes after its end."""
    monkeypatch.setattr(_recent_poses, "_LATE_S", late_s)
    measured = entries(6)
    times_ns = times_of(measured)
    poses = drive(times_ns[0] - 5 * MS_NS, times_ns[-1] + MS_NS)
    early = poses.time_ns < times_ns[2]
    with (
        running(archive=Archive(tmp_path)) as central,
        PosePublisher(central.address, ["left"]) as publisher,
        Node(central.address) as node,
    ):
        publisher.flush()
        send(publisher, part_of(poses, early))
        node.hello()
        node.measure(*measured[:3])
        node.hear_settled(12)
        node.hello(first=13, firmware="2")  # Other firmware begins a journal.
        node.measure(measured[3])
        node.hear_settled(13)
        send(publisher, part_of(poses, ~early))
        node.measure(*measured[4:])
        node.hear_settled(15)
        waiting = threading.Event()
        while not late_s and not any(event["event"] == "sealed" for event in central.events):
            waiting.wait(0.01)
    paths = sorted(tmp_path.glob("*.h5"))
    wanted = [times_ns[:3] if late_s else times_ns[:2], times_ns[3:]]
    assert [trajectory_of(path).time_ns.tolist() for path in paths] == wanted
    np.testing.assert_array_equal(trajectory_of(paths[0]).position_m, poses.at(wanted[0]).position_m)


def part_of(trajectory, kept):
    columns = {name: getattr(trajectory, name)[kept] for name in ("time_ns", "position_m", "rotation_xyzw")}
    return ertis.Trajectory(**columns, covariance=trajectory.covariance[kept])


def trajectory_of(path):
    with ertis.open_recording(path) as recording:
        return recording.trajectory


def test_poses_survive_a_killed_central_node(tmp_path):
    """The journal of a process that was killed after a commit of poses becomes a recording with them."""
    measured = entries(3)
    times_ns = times_of(measured)
    script = (
        "import sys; from tests.network.test_pose_publisher import kill_after_commit; kill_after_commit(sys.argv[1])"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], cwd=ROOT, timeout=120, check=False)
    assert done.returncode == -9
    (journal,) = tmp_path.glob(f"*.h5{SUFFIX}")
    archive = Archive(tmp_path)
    archive.open()
    archive.close()
    assert not journal.exists()
    assert trajectory_of(the_recording(tmp_path)).time_ns.tolist() == times_ns


def kill_after_commit(folder):
    """Store measurements and poses, and end this process without any clean-up."""
    measured = entries(3)
    times_ns = times_of(measured)
    with (
        running(archive=Archive(folder)) as central,
        Node(central.address) as node,
        PosePublisher(central.address, ["left"]) as publisher,
    ):
        commits = threading.Event()
        append = Journal.append_poses
        Journal.append_poses = lambda *given: (append(*given), commits.set())
        send(publisher, drive(times_ns[0], times_ns[-1]))
        node.hello()
        node.measure(*measured)
        node.hear_settled(12)
        commits.wait()
        os.kill(os.getpid(), 9)


def _send_pose(publisher):
    """Send a pose, and raise its refusal, which may arrive during either call."""
    publisher.send(5, (0, 0, 0), IDENTITY)
    publisher.flush()


def test_only_keys_of_all_sensors_may_send_poses(tmp_path):
    server = KeyPair.new("server")
    pairs = {name: KeyPair.new(name) for name in ("robot", "screen", "stranger")}
    listed = (
        Permission(name="robot", public=pairs["robot"].public, role="sensor", serials=("left",)),
        Permission(name="screen", public=pairs["screen"].public, role="application"),
    )
    AllowList(keys=listed).save(tmp_path / "allow.toml")
    keys = {name: ClientKeys(pair, server.public) for name, pair in pairs.items()}
    refusals = {
        ("robot", "right"): "key robot may not send for sensor right; allow it with 'ertis keys allow'",
        ("screen", "left"): "key screen has the role application, which may not send poses",
        ("stranger", "left"): "the central node does not know this key",
    }
    with running(tmp_path / "a", keys=ServerKeys(server, tmp_path / "allow.toml")) as central:
        for (name, sensor), wanted in refusals.items():
            with (
                PosePublisher(central.address, ["left", sensor], keys=keys[name]) as publisher,
                pytest.raises(RefusedError, match=wanted),
            ):
                _send_pose(publisher)
        with PosePublisher(central.address, ["left"], keys=keys["robot"]) as publisher:
            publisher.flush()
            assert publisher.send(5, (0, 0, 0), IDENTITY)
            publisher.flush()
    assert central.latest.refused["serial"] == 1
    assert central.latest.refused["role"] >= 1


INVALID = {
    "quaternion": ({"rotation_xyzw": (0.0, 0.0, 0.0, 2.0)}, "rotation_xyzw has length 2"),
    "infinite": ({"position_m": (float("inf"), 0.0, 0.0)}, "position_m holds inf at"),
    "far": ({"position_m": (1e9, 0.0, 0.0)}, r"position_m reaches 1e\+09 m"),
    "covariance": ({"covariance": (-1.0,) * 36}, "covariance has a negative eigenvalue"),
    "short covariance": ({"covariance": (1.0,) * 35}, "Expected `array` of length >= 36"),
    "no sensor": ({"sensors": ()}, "Expected `array` of length >= 1"),
    "time": ({"timestamp_ns": -(2**63)}, "time_ns runs from -9223372036854775808"),
    "name": ({"sensors": ("../left",)}, "Expected `str` matching regex"),
    "source": ({"source": "s" * 65}, "Expected `str` of length <= 64"),
}


def test_invalid_poses_are_refused_in_one_line_and_counted(tmp_path):
    with running(tmp_path) as central, Node(central.address) as node:
        for changes, wanted in INVALID.values():
            node.send(pose_of(**changes))
            refused = node.hear(Refused)
            assert "\n" not in refused.reason
            assert re.search(wanted, refused.reason), refused.reason
        node.send(pose_of())
        node.send(messages.Ping())
        assert isinstance(node.hear(), messages.Pong)
    assert central.latest.refused["pose"] + central.latest.refused["message"] == len(INVALID)


def accepted(**options):
    """An intake of poses, and the list of those that it has accepted."""
    stored = []
    store = type("Store", (), {"offer_pose": staticmethod(stored.append)})
    return PoseIntake(options.get("store", store)), stored


def test_rate_of_a_sender_is_limited(monkeypatch):
    intake, stored = accepted()
    now_s = [100.0]
    monkeypatch.setattr("ertis_numba.network.central_node._poses.time.monotonic", lambda: now_s[0])
    n_refused, reasons = 0, set()
    for number in range(4 * MAX_RATE_HZ):  # Twice the limit, for 2 s.
        now_s[0] = 100.0 + number / (2 * MAX_RATE_HZ)
        try:
            intake.add(b"one", pose_of(timestamp_ns=number), EVERYBODY)
        except Unwanted as error:
            reasons.add((str(error), error.kind))
            n_refused += 1
    assert reasons == {(f"poses exceed {MAX_RATE_HZ} per second; send fewer", "rate")}
    assert len(stored) + n_refused == 4 * MAX_RATE_HZ
    assert 3 * MAX_RATE_HZ - 2 <= len(stored) <= 3 * MAX_RATE_HZ  # A burst of a second, and the limit for 2 s.


def test_second_sender_of_poses_for_a_sensor_is_refused(monkeypatch):
    intake, stored = accepted()
    now_s = [100.0]
    monkeypatch.setattr("ertis_numba.network.central_node._poses.time.monotonic", lambda: now_s[0])
    one, two = {"session_id": 1}, {"session_id": 2}
    intake.add(b"one", pose_of(sensors=("left", "right"), **one), EVERYBODY)
    with pytest.raises(Unwanted, match="another application already sends poses for sensor right; end one"):
        intake.add(b"two", pose_of(sensors=("right", "top"), **two), EVERYBODY)
    intake.add(b"two", pose_of(sensors=("top",), **two), EVERYBODY)
    intake.bye(b"one")
    intake.add(b"two", pose_of(sensors=("right", "top"), **two), EVERYBODY)
    now_s[0] += messages.SILENCE_LIMIT_S + 0.1
    intake.add(b"one", pose_of(**one), EVERYBODY)
    intake.add(b"one", pose_of(sensors=("top",), **one), EVERYBODY)
    assert len(stored) == 5
    for number in range(2, 65):
        intake.add(b"%d" % number, pose_of(sensors=(f"s{number}",), session_id=number), EVERYBODY)
    with pytest.raises(Unwanted, match="64 applications already send poses; end one of them"):
        intake.add(b"65", pose_of(sensors=("s65",), session_id=65), EVERYBODY)


def test_sender_that_connects_again_remains_the_sender():
    """A connection that broke and returned is another peer; the end of the former one ends nothing."""
    intake, stored = accepted()
    intake.add(b"before", pose_of(), EVERYBODY)
    intake.add(b"after", pose_of(), EVERYBODY)
    intake.bye(b"before")
    with pytest.raises(Unwanted, match="another application already sends poses"):
        intake.add(b"other", pose_of(session_id=2), EVERYBODY)
    assert len(stored) == 2


def test_invalid_poses_count_towards_the_rate(monkeypatch):
    monkeypatch.setattr("ertis_numba.network.central_node._poses.time.monotonic", lambda: 100.0)
    intake, _ = accepted()
    for _ in range(MAX_RATE_HZ):
        with pytest.raises(Unwanted, match="invalid pose"):
            intake.add(b"one", pose_of(rotation_xyzw=(0.0, 0.0, 0.0, 2.0)), EVERYBODY)
    with pytest.raises(Unwanted, match="poses exceed"):
        intake.add(b"one", pose_of(rotation_xyzw=(0.0, 0.0, 0.0, 2.0)), EVERYBODY)


def test_central_node_without_storage_refuses_poses():
    intake, _ = accepted(store=None)
    with pytest.raises(Unwanted, match="writes no recordings that could hold poses; start it with --record"):
        intake.add(b"one", pose_of(), EVERYBODY)


numbers = st.floats()
places = st.floats(-1e9, 1e9)


@settings(max_examples=300, derandomize=True, deadline=None)
@given(
    st.builds(
        PlatformPose,
        sensors=st.lists(st.text(max_size=70), max_size=40).map(tuple) | st.just(("left", "right")),
        session_id=st.integers(0, 2**63 - 1),
        timestamp_ns=st.integers(-(2**63), 2**63 - 1),
        position_m=st.tuples(*[places] * 3) | st.tuples(*[numbers] * 3),
        rotation_xyzw=st.tuples(*[numbers] * 4) | st.just(IDENTITY),
        covariance=st.none() | st.lists(numbers, max_size=40).map(tuple) | st.just((0.5,) * 36),
        source=st.text(max_size=70),
    )
)
def test_any_pose_is_read_back_unchanged_or_refused(pose):
    """Whatever the fields contain, an accepted pose can be stored and read back, and no other error arises."""
    intake, stored = accepted()
    with contextlib.suppress(ertis.DataError, UnicodeEncodeError, Unwanted):
        intake.add(b"one", messages.decode(messages.encode(pose)), EVERYBODY)
    for each in stored:
        row = each.row()
        assert JournalPose.from_row(Path("rec.h5.journal"), (1, *row, row_crc32(row))) == each


def test_publisher_reports_a_missing_central_node():
    with (
        PosePublisher("tcp://127.0.0.1:9", ["left"]) as publisher,
        pytest.raises(NetworkError, match=r"no answer from tcp://127\.0\.0\.1:9 within 0\.1 s; start a central node"),
    ):
        publisher.flush(0.1)
    with pytest.raises(NetworkError, match="this publisher is not open; use it in a with statement"):
        publisher.send(5, (0, 0, 0), IDENTITY)


def test_publisher_sends_a_pose_although_an_earlier_one_is_refused():
    with contextlib.ExitStack() as stack:
        context = zmq.Context()
        stack.callback(context.destroy, linger=0)
        server = sockets.server(context, "tcp://127.0.0.1:0", keys=None)
        publisher = stack.enter_context(PosePublisher(sockets.bound(server), ["left"]))
        publisher.send(5, (0, 0, 0), IDENTITY)
        connection = publisher._connection  # noqa: SLF001
        while not server.poll(10):
            publisher._has_sent(connection)  # noqa: SLF001
        peer, _ = server.recv_multipart()
        server.send_multipart([peer, messages.encode(Refused(code="size", reason="too many"))])
        assert connection._socket.poll(60_000)  # noqa: SLF001
        with pytest.raises(RefusedError, match="too many"):
            publisher.send(6, (0, 0, 0), IDENTITY)
        assert server.poll(60_000)
        assert messages.decode(server.recv_multipart()[1]).timestamp_ns == 6


def test_flush_reports_an_interrupted_connection_once(tmp_path):
    with reserved_address() as address, contextlib.ExitStack() as stack:
        with running(tmp_path / "a", address=address) as central:
            publisher = stack.enter_context(PosePublisher(central.address, ["left"]))
            publisher.flush(60.0)
            publisher.send(5, (0, 0, 0), IDENTITY)
            publisher.flush(60.0)
            publisher.send(6, (0, 0, 0), IDENTITY)
        with running(tmp_path / "b", address=address) as other:
            with pytest.raises(NetworkError, match="was interrupted, so that up to 1 sent pose may be lost"):
                publisher.flush(60.0)
            publisher.send(7, (0, 0, 0), IDENTITY)
            publisher.flush(60.0)
        assert other.latest.archive.poses == 1


def test_publisher_checks_its_arguments():
    address = "tcp://127.0.0.1:5601"
    with pytest.raises(ArgumentError, match="sensors is 'left'; pass a list of 1 to 32 names"):
        PosePublisher(address, "left")
    with pytest.raises(ArgumentError, match=r"sensors is \[\]; pass a list of 1 to 32 names"):
        PosePublisher(address, [])
    with pytest.raises(ArgumentError, match="source has 0 characters; use 1 to 64"):
        PosePublisher(address, ["left"], source="")
    with PosePublisher(address, ["left"]) as publisher:
        with pytest.raises(ArgumentError, match="rotation_xyzw has length 2"):
            publisher.send(5, (0, 0, 0), (0, 0, 0, 2))
        with pytest.raises(ArgumentError, match=r"timestamp_ns is 1\.5; use a whole number"):
            publisher.send(1.5, (0, 0, 0), IDENTITY)


def test_map_needs_no_trajectory_file(tmp_path):
    """A post that two processes see: `ertis record` stores what a sensor node and a NumPy script send."""
    scene = Scene(
        seed=6,
        rate_hz=10.0,
        count=3,
        sensors=(
            Sensor(
                name="left",
                position_m=(0.1, 0.0, 0.4),
                processing=Processing(range_m=(0.4, 2.2), directions="90"),
                electronics=Electronics(noise_dbfs=-60.0),
            ),
        ),
        points=(Point(position_m=(1.4, 0.3, 0.4), strength_db=0.0),),
    )
    measured = [JournalEntry(ertis.render(scene, number, sensor="left"), 1_000 + number) for number in range(3)]
    script = tmp_path / "poses.py"
    script.write_text(SCRIPT)
    place = {"translation_m": (0.1, 0.0, 0.4), "rotation_xyzw": IDENTITY}
    with Recording(tmp_path / "rec") as central, Node(central.address) as node:
        command = [sys.executable, script, central.address]
        with subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as process:
            # A node keeps poses before the first measurement for some seconds only, and processes may end slowly.
            assert process.stdout.readline() == "sent\n"
            node.hello("left", first=0, session_id=0, settings=measured[0].measurement.settings, **place)
            node.measure(*measured)
            node.hear_settled(2)
        assert process.returncode == 0
        central.process.send_signal(signal.SIGTERM)
        assert central.event("sealed")["text"] == "1 measurement has no pose, because poses were missing at its time"
    recording = the_recording(tmp_path / "rec")
    done = CliRunner().invoke(cli, ["map", str(recording), "-o", str(tmp_path / "m.h5")])
    assert done.exit_code == 0, done.output
    assert "note: 1 pulse of 3 outside of the time of the poses left out" in done.stderr
    occupied_m = ertis.read_map(tmp_path / "m.h5").occupied_m
    assert np.hypot(*(occupied_m - [11.4, 0.3]).T).max() < 0.1


SCRIPT = """
import sys
from ertis_numba.network.pose_publisher import PosePublisher

with PosePublisher(sys.argv[1], ["left"]) as publisher:
    for time_ns in range(0, 160_000_000, 10_000_000):
        publisher.send(time_ns, (10.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    publisher.flush(60.0)
    print("sent", flush=True)
"""


def test_disk_that_fails_while_poses_are_stored_loses_nothing(tmp_path, monkeypatch):
    """After the error, measurements and poses go into another journal; those acknowledged before stay in the first."""
    measured = entries(6)
    times_ns = times_of(measured)
    append, fails = Journal.append_poses, threading.Event()

    def append_or_fail(journal, poses):
        if not fails.is_set():
            fails.set()
            raise DataError("the disk has failed")
        append(journal, poses)

    monkeypatch.setattr(Journal, "append_poses", append_or_fail)
    with (
        running(archive=Archive(tmp_path)) as central,
        PosePublisher(central.address, ["left"]) as publisher,
        Node(central.address) as node,
    ):
        publisher.flush()
        send(publisher, drive(times_ns[0], times_ns[-1]))
        node.hello()
        node.measure(*measured[:3])
        node.hear_settled(12)
        assert fails.wait(60.0)
        node.measure(*measured[3:])
        node.hear_settled(15)
    found = [trajectory_of(path) for path in sorted(tmp_path.glob("*.h5"))]
    assert np.concatenate([each.time_ns for each in found if each is not None]).tolist()[-3:] == times_ns[3:]
    assert stored(tmp_path)[0] == wanted(measured)
    assert [event["event"] for event in central.events].count("fault") == 1
