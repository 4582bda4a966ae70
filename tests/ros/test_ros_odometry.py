"""Odometry as live ROS 2 topics."""

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import DataError
from ertis_numba.frames import PointCloud, Stamp
from ertis_numba.interop.ros_messages import odometry_message, odometry_transform
from ertis_numba.motion import EgoVelocity, PlanarPose
from ertis_numba.motion.live import LiveOdometry
from ertis_numba.ros import Participant, PublishingSettings, RosPublisher
from ertis_numba.settings import Settings
from ertis_numba.storage import write_energyscapes
from tests.network.test_odometry_subscriber import MOUNTING_FILE, images
from tests.publishing import Publisher, end_when, results_of
from tests.ros_topics import DOMAIN, await_subscribers, subscribed

pytest.importorskip("rclpy.serialization")  # Wheels exist for some versions of Python only.
pytest.importorskip("cyclonedds")

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre:DeprecationWarning")  # a dependency of rclpy imports them

ODOMETRY = "nav_msgs/msg/Odometry"
TIME_NS = 1_700_000_000_000_000_000
PLACE = ((0.2, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
SPEED_M_S = 0.5


def cloud(pulse, sensor="front"):
    """Points of reflectors at rest, seen from a platform that drives forward."""
    draws = np.random.default_rng(3)
    place_m = np.column_stack([draws.uniform(1.2, 3, 30), draws.uniform(-1, 1, 30), np.zeros(30)])
    stamp = Stamp(sensor=sensor, sync_count=pulse, timestamp_ns=TIME_NS + pulse * 100_000_000)
    position_m = (place_m - [0.1 * SPEED_M_S * pulse, 0.0, 0.0]).astype(np.float32)
    return PointCloud(position_m, np.ones(30, np.float32), Settings(), stamp)


def decoded(data):
    from nav_msgs.msg import Odometry  # noqa: PLC0415  wheels may be missing
    from rclpy.serialization import deserialize_message  # noqa: PLC0415  wheels may be missing

    return deserialize_message(data, Odometry)


def test_odometry_arrives_in_rclpy():
    pytest.importorskip("nav_msgs.msg")  # Wheels exist for some versions of Python only.
    found = []
    with (
        subscribed({"/robot1/odom": ODOMETRY}) as subscriber,
        Participant(domain=DOMAIN) as participant,
        RosPublisher(participant, namespace="robot1", odometry=True, alone=True) as ros,
    ):
        await_subscribers([ros.topics["/robot1/odom"]])
        for pulse in range(4):
            ros.publish(cloud(pulse), PLACE)
            found.append(decoded(subscriber.take(1)["/robot1/odom"][0]))
        counts = {name: topic.published for name, topic in ros.topics.items()}
    assert counts["/robot1/odom"] == counts["/tf"] == 4
    first, last = found[0], found[3]
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "base_link")
    assert last.header.stamp.nanosec == 300_000_000
    assert last.pose.pose.position.x == pytest.approx(0.3 * SPEED_M_S, abs=5e-3)
    assert last.twist.twist.linear.x == pytest.approx(SPEED_M_S, abs=0.01)
    covariance = np.reshape(last.pose.covariance, (6, 6))
    assert np.all(np.diag(covariance)[[0, 1, 5]] > 0)
    assert not covariance[2:5].any()
    # The velocity at the first pulse is unknown.
    assert np.sqrt(np.diag(np.reshape(first.twist.covariance, (6, 6))))[[0, 1]].tolist() == [2.0, 2.0]


def test_odometry_messages_agree_with_the_pose():
    pose = PlanarPose(TIME_NS, 1.0, -2.0, math.pi / 2, np.diag([1e-4, 2e-4, 3e-4]))
    velocity = EgoVelocity(np.array([0.5, -0.1]), 0.2, np.diag([4e-4, 5e-4, 6e-4]), TIME_NS, 0.1, 30)
    message, transform = odometry_message(pose, velocity), odometry_transform(pose)
    assert (transform["header"], transform["child_frame_id"]) == (message["header"], message["child_frame_id"])
    assert transform["transform"]["translation"] == message["pose"]["pose"]["position"] == {"x": 1.0, "y": -2.0, "z": 0}
    half = math.sqrt(0.5)
    assert message["pose"]["pose"]["orientation"] == pytest.approx({"x": 0.0, "y": 0.0, "z": half, "w": half})
    assert np.diag(np.reshape(message["pose"]["covariance"], (6, 6))).tolist() == [1e-4, 2e-4, 0, 0, 0, 3e-4]
    assert np.diag(np.reshape(message["twist"]["covariance"], (6, 6))).tolist() == [4e-4, 5e-4, 0, 0, 0, 6e-4]
    assert message["twist"]["twist"]["linear"] == {"x": 0.5, "y": -0.1, "z": 0.0}
    assert message["twist"]["twist"]["angular"]["z"] == 0.2


def test_sensor_without_mounting_is_left_out_and_noted():
    notes = []
    with Participant(domain=DOMAIN) as participant:
        with RosPublisher(participant, odometry=True, on_note=notes.append) as ros:
            for pulse in range(2):
                ros.publish(cloud(pulse, "back"))
                ros.publish(cloud(pulse), PLACE)
        assert ros.topics["/odom"].published + ros.skipped == 2
    assert notes == ["odometry leaves out sensor back, whose mounting is unknown; add the mounting (mounting)"]


def test_odometry_continues_while_paused():
    with Participant(domain=DOMAIN) as participant:
        with RosPublisher(participant, odometry=True, settings=PublishingSettings(paused=True)) as ros:
            ros.publish(cloud(0), PLACE)
        assert ros.topics["/odom"].published == 0


def test_failure_of_odometry_is_noted_and_raised_at_the_end(monkeypatch):
    def fail(*_):
        raise DataError("no luck")

    monkeypatch.setattr(LiveOdometry, "add", fail)
    notes = []
    with Participant(domain=DOMAIN) as participant:
        ros = RosPublisher(participant, odometry=True, on_note=notes.append)
        ros.publish(cloud(0), PLACE)
        with pytest.raises(DataError, match="no luck"):
            ros.close()
        ros.close()
        assert ros.topics["/front/points"].published == 1
    assert notes == ["odometry has ended: no luck"]


@pytest.fixture
def mounting(tmp_path):
    path = tmp_path / "mounting.toml"
    path.write_text(MOUNTING_FILE)
    return path


def test_command_publishes_the_odometry_of_a_file(tmp_path, mounting):
    path = tmp_path / "images.h5"
    write_energyscapes(path, images(*range(5)))
    arguments = ["--odometry", "--mounting", str(mounting), "--domain", str(DOMAIN), "--use-sim-time", "--json"]
    done = CliRunner().invoke(cli, ["ros", str(path), *arguments])
    assert done.exit_code == 0, done.output
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert {"event": "topic", "topic": "/odom", "message": ODOMETRY} in lines
    end = lines[-1]
    assert end["messages"]["/odom"] == end["messages"]["/tf"] == 5 - end["skipped"]


def test_command_publishes_the_odometry_of_a_central_node(mounting, monkeypatch):
    made = results_of(monkeypatch, RosPublisher, "__enter__")
    end_when(
        monkeypatch,
        "ertis_cli.ros",
        lambda: made and all(name in made[0].topics for name in ("/odom", "/tf", "/front/points")),
    )
    arguments = ["--odometry", "--topic", "points", "--domain", str(DOMAIN), "--duration", "4", "--json"]
    with Publisher() as publisher, publisher.playing(images(*range(4))):
        done = CliRunner().invoke(cli, ["ros", publisher.address, "--mounting", str(mounting), *arguments])
    assert done.exit_code == 0, done.output
    end = json.loads(done.stdout.splitlines()[-1])
    assert end["messages"]["/front/points"] > 0
    assert 1 <= end["messages"]["/odom"] == end["messages"]["/tf"] <= 4
