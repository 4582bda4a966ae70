"""The ROS 2 examples stop a simulated robot in front of a simulated wall, and store its odometry."""

import contextlib
import importlib.util
import itertools
import queue
import signal
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.network.central_node import Archive
from ertis_numba.pipeline import Pipeline
from ertis_numba.ros import Participant, PublishingSettings, RosPublisher
from ertis_numba.settings import Processing, Settings
from ertis_numba.simulation import Scene, Sensor, Wall
from ertis_numba.simulation.render import render
from tests.central import Node as CentralTestNode, running
from tests.journals import ENVIRONMENT, entries
from tests.ros_topics import DOMAIN, await_subscribers, subscribed

pytest.importorskip("rclpy.serialization")  # Wheels exist for some versions of Python only.
pytest.importorskip("cyclonedds")

EXAMPLE = Path(__file__).parents[2] / "examples" / "6_stop_in_ros.py"
POSES = EXAMPLE.with_name("7_poses_from_ros.py")
START_M, STOP_M, STEP_S = 2.0, 0.8, 0.4
STEP_M, HIDDEN_M = 0.2, 3.5  # Distance of a step, and of a wall beyond the range.
MAX_STEPS, N_PERIODS = 40, 6


def image_at(distance_m, pipeline):
    """Image of a wall at a distance ahead."""
    wall = Wall(position_m=(distance_m, 0.0, 0.0), facing_deg=(180.0, 0.0), size_m=(2.0, 2.0))
    sensor = Sensor(name="front", processing=pipeline.settings.processing)
    return pipeline.process(render(Scene(walls=(wall,), sensors=(sensor,))))


@pytest.fixture(scope="module")
def images():
    """Images of walls at the distances of a robot that approaches, and of one that is too near."""
    settings = Settings().replace(processing=Processing(directions="2d:91", range_m=(0.3, 3.0)))
    with Pipeline(settings, predict=False) as pipeline:
        return {
            distance_m: image_at(distance_m, pipeline)
            for distance_m in [*np.arange(0.2, START_M + 0.1, STEP_M).round(1).tolist(), HIDDEN_M]
        }


@contextlib.contextmanager
def driving(example, image):
    """Run an example, and yield its process, a function that publishes an image as a scan, and its velocities."""
    environment = ENVIRONMENT | {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_LOG_DIR": tempfile.gettempdir()}
    with (
        Participant(domain=DOMAIN) as participant,
        subscribed({"/cmd_vel": "geometry_msgs/msg/Twist"}, domain=DOMAIN) as subscriber,
        subprocess.Popen([sys.executable, example, "/front/scan"], env=environment) as node,
    ):
        try:
            ros = RosPublisher(participant, topics=["scan"], settings=PublishingSettings(floor_dbfs=-60.0))
            ros.publish(image)
            await_subscribers([ros.topics["/front/scan"]])
            yield node, ros.publish, subscriber
        finally:
            node.terminate()


def speed_after(image, publish, subscriber):
    """Speed once the node has had time for the scans of several periods."""
    for _ in range(N_PERIODS):
        publish(image)
        speed_m_s = speed_of(subscriber.take_after(time.time_ns()))
    return speed_m_s


def test_robot_stops_in_front_of_a_wall(images, tmp_path):
    """The robot stops. It also stands if the wall is too near, and at the end of the node."""
    code = EXAMPLE.read_text("utf-8")
    assert code.count("SILENCE_S = 0.5\n") == 1
    patient = tmp_path / EXAMPLE.name  # On a busy machine, scans arrive late.
    patient.write_text(code.replace("SILENCE_S = 0.5\n", "SILENCE_S = 60.0\n"), "utf-8")
    distances_m = [START_M]
    with driving(patient, images[START_M]) as (node, *published):
        for _ in range(MAX_STEPS):
            speed_m_s = speed_after(images[distances_m[-1]], *published)
            distances_m.append(round(distances_m[-1] - speed_m_s * STEP_S, 1))
            if speed_m_s == 0 and len(distances_m) > 3:
                break
        assert speed_after(images[HIDDEN_M], *published) == 0  # A wall that is too near gives no echo.
        assert speed_after(images[START_M], *published) > 0
        node.send_signal(signal.SIGINT)
        await_stop(published[1])  # The last velocity is 0.
        assert node.wait(60) == 0
    assert STOP_M - 0.5 * STEP_S - 0.05 <= distances_m[-1] <= STOP_M + 0.02
    assert all(before >= after for before, after in itertools.pairwise(distances_m))


def test_robot_stops_if_scans_end(images):
    with driving(EXAMPLE, images[START_M]) as (_, *published):
        # On a busy machine, the robot stands until scans arrive in time.
        assert any(speed_after(images[START_M], *published) > 0 for _ in range(MAX_STEPS))
        await_stop(published[1])


def test_odometry_of_a_robot_is_stored_with_the_measurements(tmp_path):
    """Poses of ROS 2 reach the recording of a central node, with their covariances."""
    measured = entries(3)
    times_ns = [entry.measurement.stamp.timestamp_ns for entry in measured]
    poses = ertis.Trajectory(
        [times_ns[0] - 10**8, times_ns[-1] + 10**8],
        [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]],
        [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.6, 0.8]],
        [np.eye(6), 2 * np.eye(6)],
        "odometry",
    )
    environment = ENVIRONMENT | {"ROS_DOMAIN_ID": str(DOMAIN), "ROS_LOG_DIR": tempfile.gettempdir()}
    arrived = queue.SimpleQueue()
    archive = Archive(tmp_path)
    archive.offer_pose = lambda pose: (Archive.offer_pose(archive, pose), arrived.put(pose))
    with (
        running(archive=archive) as central,
        Participant(domain=DOMAIN) as participant,
        subprocess.Popen([sys.executable, POSES, "/odom", central.address, "left"], env=environment) as node,
    ):
        try:
            topic = participant.topic("/odom", "nav_msgs/msg/Odometry")
            await_subscribers([topic])
            seen_ns = set()
            unturned = odometry_of(poses.time_ns[0].item(), [0.0] * 3, [0.0] * 4, [0.0] * 36)  # No rotation is known.
            for _ in range(60):  # A subscriber that has not discovered the publisher yet misses messages.
                topic.publish(unturned)
                for time_ns, place, turn, covariance in zip(
                    poses.time_ns.tolist(), poses.position_m, poses.rotation_xyzw, poses.covariance, strict=True
                ):
                    topic.publish(odometry_of(time_ns, place.tolist(), turn.tolist(), covariance.ravel().tolist()))
                with contextlib.suppress(queue.Empty):
                    while len(seen_ns) < len(poses):
                        seen_ns.add(arrived.get(timeout=1.0).timestamp_ns)
                if len(seen_ns) == len(poses):
                    break
            assert seen_ns == set(poses.time_ns.tolist())
            node.send_signal(signal.SIGINT)
            assert node.wait(60) == 0
        finally:
            node.kill()
        with CentralTestNode(central.address) as sensor:
            sensor.hello()
            sensor.measure(*measured)
            sensor.hear_settled(12)
    (path,) = tmp_path.glob("*.h5")
    with ertis.open_recording(path) as recording:
        found, wanted = recording.trajectory, poses.at(times_ns)
    assert found.source == "odometry"
    for part in ("time_ns", "position_m", "rotation_xyzw", "covariance"):
        np.testing.assert_allclose(getattr(found, part), getattr(wanted, part), rtol=1e-12)


def odometry_of(time_ns, place, turn, covariance):
    """Message of the odometry of a robot, as a dict."""
    stamp = {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}
    pose = {
        "position": dict(zip("xyz", place, strict=True)),
        "orientation": dict(zip("xyzw", turn, strict=True)),
    }
    none = {"linear": dict.fromkeys("xyz", 0.0), "angular": dict.fromkeys("xyz", 0.0)}
    return {
        "header": {"stamp": stamp, "frame_id": "odom"},
        "child_frame_id": "base_link",
        "pose": {"pose": pose, "covariance": covariance},
        "twist": {"twist": none, "covariance": [0.0] * 36},
    }


def speed_of(message):
    """Forward speed of a message."""
    return struct.unpack_from("<d", message, 4)[0]


def await_stop(subscriber):
    while any(speed_of(message) > 0 for message in subscriber.take(1)["/cmd_vel"]):
        pass


def test_scan_without_echoes_in_the_way_is_clear():
    messages = importlib.import_module("sensor_msgs.msg")
    spec = importlib.util.spec_from_file_location("example", EXAMPLE)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    scan = messages.LaserScan(angle_min=-1.5, angle_increment=1.5, ranges=[0.4, float("inf"), 0.4])
    assert example.distance_ahead_m(scan) == float("inf")
    scan.ranges[1] = 1.25
    assert example.distance_ahead_m(scan) == 1.25
