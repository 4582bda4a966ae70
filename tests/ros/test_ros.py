"""Live topics arrive in rclpy, which runs in another process, byte for byte."""

import json
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner
from ertis_cli._ros_sources import publish_node
from ertis_cli.main import cli

from ertis_numba.analysis.point_finder import PointFinder
from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices.emulator import Emulator
from ertis_numba.frames import Stamp
from ertis_numba.interop.ros_definitions import encoder
from ertis_numba.interop.ros_messages import MESSAGES, ImageMessages, points_message
from ertis_numba.interop.scans import scan_message
from ertis_numba.network.status import SensorStatus, Status
from ertis_numba.ros import Participant, PublishingSettings, RosPublisher, interfaces
from ertis_numba.ros.diagnostics import diagnostics_message
from ertis_numba.storage import open_recording, write_energyscapes, write_recording
from tests.cli.test_acoustic_map_commands import heard
from tests.files import image
from tests.journals import ENVIRONMENT
from tests.publishing import Publisher, status
from tests.ros_topics import DOMAIN, OTHER_DOMAIN, await_subscribers, subscribed

pytest.importorskip("rclpy.serialization")  # Wheels exist for some versions of Python only.
pytest.importorskip("cyclonedds")

ROOT = Path(__file__).parents[2]
TIME_NS = 1_700_000_000_123_456_789
DEPTH = 100  # A subscriber that has not caught up misses messages older than the newest of this number.
PLACE = ((1.0, 2.0, 0.5), (0.0, 0.0, 0.6, 0.8))


def stamped(seed, sensor="front", sequence=0):
    return image(seed=seed).replace(stamp=Stamp(sensor=sensor, sequence=sequence, timestamp_ns=TIME_NS + sequence))


def equal(received, message, kind):
    """True if received bytes are the encoded message; rclpy may add bytes that fill up the last word."""
    encoded = encoder(kind)(message)
    return received[: len(encoded)] == encoded and len(received) - len(encoded) < 4


def test_topics_arrive_in_rclpy():
    given = [stamped(seed, sequence=seed) for seed in range(20)]
    names = {topic: f"/robot1/front/{topic}" for topic in ("points", "scan", "image")}
    find, picture = PointFinder(), ImageMessages()
    expected = {
        "points": [points_message(find(each)) for each in given],
        "scan": [scan_message(each) for each in given],
        "image": [picture(each) for each in given],
    }
    kinds = {names[topic]: MESSAGES[topic] for topic in names}
    with Participant(domain=DOMAIN, depth=DEPTH) as participant:
        ros = RosPublisher(participant, topics=names, namespace="robot1")
        ros.publish(given[0], PLACE)  # creates the topics, before there are subscribers that could receive this image
        with subscribed(kinds) as subscriber:
            await_subscribers([ros.topics[name] for name in kinds])
            for each in given:
                ros.publish(each, PLACE)
            taken = subscriber.take(3 * len(given))
    assert ros.dropped == 0
    for topic, name in names.items():
        assert len(taken[name]) == len(given)
        assert all(equal(*pair, MESSAGES[topic]) for pair in zip(taken[name], expected[topic], strict=True))


def test_points_without_an_image_are_published_alone():
    cloud = PointFinder()(stamped(1))
    with subscribed({"/front/points": MESSAGES["points"]}) as subscriber, Participant(domain=DOMAIN) as participant:
        ros = RosPublisher(participant)
        ros.publish(cloud)
        await_subscribers([ros.topics["/front/points"]])
        ros.publish(cloud)
        (received,) = subscriber.take(1)["/front/points"]
    assert equal(received, points_message(cloud), MESSAGES["points"])
    assert list(ros.topics) == ["/front/points"]


def test_status_and_clock_arrive_in_rclpy():
    sensors = {
        "front": SensorStatus(connected=True, rate_hz=10.0),
        "left": SensorStatus(connected=False),
        "right": SensorStatus(connected=True, missing={"unplugged": 3}),
    }
    status = Status(
        version="1", pid=1, host="h", address="tcp://a:1", state="processing", sensors=sensors, time_ns=TIME_NS
    )
    kinds = {"/diagnostics": "diagnostic_msgs/msg/DiagnosticArray", "/clock": "rosgraph_msgs/msg/Clock"}
    with subscribed(kinds) as subscriber, Participant(domain=DOMAIN) as participant:
        ros = RosPublisher(participant)
        ros.publish_status(status)
        ros.publish_clock(TIME_NS)
        await_subscribers(ros.topics.values())
        ros.publish_status(status)
        ros.publish_clock(TIME_NS)
        taken = subscriber.take(2)
    message = diagnostics_message(status)
    assert equal(taken["/diagnostics"][0], message, kinds["/diagnostics"])
    clock = {"clock": {"sec": TIME_NS // 10**9, "nanosec": TIME_NS % 10**9}}
    assert equal(taken["/clock"][0], clock, kinds["/clock"])
    levels = {row["hardware_id"]: (row["level"], row["message"]) for row in message["status"]}
    assert levels == {
        "h": (0, "processing"),
        "front": (0, "10.0 Hz"),
        "left": (3, "not connected"),
        "right": (1, "3 measurements missing"),
    }


def test_other_domains_receive_nothing():
    with (
        subscribed({"/clock": "rosgraph_msgs/msg/Clock"}, domain=OTHER_DOMAIN),
        subscribed({"/clock": "rosgraph_msgs/msg/Clock"}),
        Participant(domain=DOMAIN) as participant,
    ):
        ros = RosPublisher(participant)
        ros.publish_clock(1)
        await_subscribers(ros.topics.values())
        assert ros.topics["/clock"].n_subscribers == 1


def test_subscriber_that_was_stopped_does_not_block_the_publisher():
    kinds = {"/front/points": MESSAGES["points"]}
    with (
        subscribed(kinds) as good,
        subscribed(kinds) as stopped,
        Participant(domain=DOMAIN, depth=DEPTH) as participant,
    ):
        ros = RosPublisher(participant)
        ros.publish(stamped(1))
        await_subscribers([ros.topics["/front/points"]], 2)
        stopped.pause()
        for seed in range(100):
            ros.publish(stamped(seed, sequence=seed))
        assert len(good.take(100)["/front/points"]) == 100
        assert ros.dropped == 0


def test_rate_of_a_topic_is_limited():
    with Participant(domain=DOMAIN) as participant:
        ros = RosPublisher(participant, settings=PublishingSettings(max_rate_hz={"points": 4.0}))
        for number in range(41):  # 20 Hz for 2 s
            stamp = Stamp(sensor="front", sequence=number, timestamp_ns=TIME_NS + number * 50_000_000)
            ros.publish(image().replace(stamp=stamp))
        counts = {name: topic.published for name, topic in ros.topics.items()}
    assert counts == {"/front/points": 9, "/front/scan": 41}
    assert ros.left_out == 32


def test_transforms_are_published_when_they_change():
    with Participant(domain=DOMAIN) as participant:
        ros = RosPublisher(participant)
        ros.publish(stamped(1))
        assert "/tf_static" not in ros.topics
        for place in (PLACE, PLACE, ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))):
            ros.publish(stamped(1), place)
        assert ros.topics["/tf_static"].published == 2


def published(subscriber, count, *arguments):
    """Return messages that reach a subscriber while the command runs, and the events that it reports."""
    command = [sys.executable, "-m", "ertis_cli", "ros", *map(str, arguments), "--domain", str(DOMAIN), "--json"]
    with subprocess.Popen(
        command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        taken = subscriber.take(count)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate()
    assert process.returncode == 0, stderr
    return taken, [json.loads(line) for line in stdout.splitlines()]


def test_command_publishes_a_file(tmp_path):
    path = tmp_path / "images.h5"
    write_energyscapes(path, [stamped(seed, sequence=50_000_000 * seed) for seed in range(5)])
    kinds = {"/front/points": MESSAGES["points"], "/front/scan": MESSAGES["scan"]}
    with subscribed(kinds) as subscriber:
        taken, lines = published(subscriber, 12, path, "--loop", "--use-sim-time")  # 6 of each, more than the file has
    assert lines[0]["event"] == "publishing"
    assert {line["topic"] for line in lines if line["event"] == "topic"} == {"/clock", *kinds}
    assert lines[-1]["event"] == "end"
    assert lines[-1]["messages"]["/front/points"] == lines[-1]["measurements"] > 5
    assert sum(map(len, taken.values())) == 12


def test_command_publishes_the_images_of_sensors(tmp_path, monkeypatch):
    monkeypatch.setitem(ENVIRONMENT, "ERTIS_EMULATED_DIR", str(tmp_path))
    kinds = {f"/{name}/points": MESSAGES["points"] for name in ("one", "two")}
    with open_recording(ROOT / "data" / "synthetic" / "reflectors.h5") as recording:
        words, settings = recording[0].data, recording.settings
    (tmp_path / "settings.toml").write_text(settings.to_toml())
    with (
        Emulator([words], name="one", link=tmp_path / "one"),
        Emulator([words], name="two", link=tmp_path / "two"),
        subscribed(kinds) as subscriber,
    ):
        settings = ["--settings", tmp_path / "settings.toml"]
        taken, lines = published(subscriber, 10, "one", "two", *settings, "--trigger-rate", "20")
    end = lines[-1]
    assert end["messages"]["/one/points"] >= len(taken["/one/points"])
    assert end["measurements"] == sum(end["messages"][name] for name in kinds)
    assert sum(map(len, taken.values())) == 10
    frame, n_points = taken["/one/points"][0][16:19], len(taken["/one/points"][0])
    assert (frame, n_points > 200) == (b"one", True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.h5"], "file missing.h5 does not exist; choose an existing file, an address, or ports"),
        (["one", "tcp://127.0.0.1:1"], "several sources are given, but only ports can be combined"),
        (["one", "one"], "port one is given 2 times"),
        (["one", "--loop"], "--loop is for files; remove it with ports"),
        (["tcp://127.0.0.1:1", "--trigger", "sync"], "--trigger is for ports; remove it with an address"),
        (["tcp://127.0.0.1:1", "--preset", "short_25_50"], "--preset is for ports; remove it with an address"),
        (["one", "--sensor", "one"], "--sensor selects sensors of a file or an address"),
    ],
)
def test_sources_that_do_not_go_together_are_refused(arguments, message):
    done = CliRunner().invoke(cli, ["ros", *arguments])
    assert done.exit_code == 2
    assert message in done.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"domain": 233}, "domain is 233; use a whole number from 0 to 232"),
        ({"domain": -1}, "domain is -1"),
        ({"interface": "nothing0"}, r"interface 'nothing0' is unknown.*known are lo"),
        ({"reliability": "both"}, "reliability 'both' is unknown"),
        ({"depth": 0}, "depth is 0"),
    ],
)
def test_participant_refuses_invalid_arguments(options, message):
    with pytest.raises(ArgumentError, match=message):
        Participant(**options)


def test_domain_comes_from_the_environment(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    with Participant() as participant:
        assert participant.domain == DOMAIN
    monkeypatch.setenv("ROS_DOMAIN_ID", "x")
    with pytest.raises(ArgumentError, match="ROS_DOMAIN_ID is 'x'; use a number from 0 to 232"):
        Participant()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"topics": ["cloud"]}, "topic 'cloud' is unknown"),
        ({"namespace": "9a"}, "namespace '9a' is not allowed in ROS; choose names"),
        ({"namespace": "a//b"}, "namespace 'a//b' is not allowed"),
    ],
)
def test_publisher_refuses_invalid_arguments(options, message):
    with Participant(domain=DOMAIN) as participant, pytest.raises(ArgumentError, match=message):
        RosPublisher(participant, **options)


def test_later_sensor_of_the_same_topics_gets_a_number():
    with Participant(domain=DOMAIN) as participant:
        ros = RosPublisher(participant, topics=["points"])
        for name in ("a.b", "a-b", "a_b", "a.b"):
            ros.publish(stamped(1, name))
        assert [name for name in ros.topics if "points" in name] == ["/a_b/points", "/a_b_2/points", "/a_b_3/points"]


def test_loopback_is_the_default():
    assert "lo" in interfaces()
    with Participant(domain=DOMAIN) as participant:
        assert participant.interface == "lo"


def test_command_reports_that_no_central_node_answers(monkeypatch):
    monkeypatch.setattr("ertis_cli._ros_sources._UNANSWERED_S", 0.3)
    address = "tcp://127.0.0.1:9"
    done = CliRunner().invoke(cli, ["ros", address, "--domain", str(DOMAIN), "--duration", "3"])
    assert done.exit_code == 1
    assert f"waiting for {address}: no answer; is 'ertis serve' running?\n" in done.stderr
    assert done.stderr.endswith(
        f"error: nothing arrived from {address}; start 'ertis serve', and use the address at which it publishes\n"
    )


def test_left_out_measurements_are_not_counted_as_published(tmp_path):
    path = tmp_path / "images.h5"
    write_energyscapes(path, [stamped(seed, sequence=50_000_000 * seed) for seed in range(9)])
    command = ["ros", str(path), "--domain", str(DOMAIN), "--max-rate", "points=5", "--max-rate", "scan=5", "--json"]
    done = CliRunner().invoke(cli, [*command, "--use-sim-time"])
    assert done.exit_code == 0, done.output
    last = json.loads(done.stdout.splitlines()[-1])
    assert (last["measurements"], last["left_out"], last["messages"]["/front/points"]) == (3, 12, 3)
    assert "3 measurements published, 12 messages left out by rates or pauses" in done.stderr


@pytest.mark.filterwarnings("error")
def test_measurements_of_a_file_without_a_call_are_left_out(tmp_path):
    path, silent = tmp_path / "mixed.h5", tmp_path / "silent.h5"
    write_recording(path, heard(["active", "passive", "active", "passive", "passive"]))
    write_recording(silent, heard(["passive"] * 2))
    common = ["--domain", str(DOMAIN), "--use-sim-time", "--json"]
    done = CliRunner().invoke(cli, ["ros", str(path), *common])
    assert done.exit_code == 0, done.output
    *_, last = events = [json.loads(line) for line in done.stdout.splitlines()]
    assert (last["measurements"], last["left_out"], last["messages"]["/sensor/points"]) == (2, 3, 2)
    (note,) = [event["text"] for event in events if event["event"] == "note"]
    assert note.startswith("note: 3 measurements without a call left out; ")
    assert "Warning" not in done.stderr
    done = CliRunner().invoke(cli, ["ros", str(silent), *common])
    assert done.exit_code == 1
    assert "silent.h5: all measurements are passive and have no echoes" in done.stderr


def test_central_node_without_images_of_a_sensor_is_noted_once():
    states = {"front": SensorStatus(connected=True, passive=3), "left": SensorStatus(connected=True)}
    received, notes = [], []
    with Publisher() as publisher, publisher.playing([status(sensors=states) for _ in range(2)]):
        publish_node(
            publisher.address,
            SimpleNamespace(publish_status=received.append),
            images=True,
            sensors=(),
            keys=None,
            is_over=lambda: len(received) == 2,
            on_note=notes.append,
            on_published=lambda: None,
            on_ready=lambda: None,
            signals=SimpleNamespace(obey=lambda _: None),
        )
    assert [note for note in notes if note.startswith("note")] == [
        "note: sensor front has measurements without a call, which yield no images"
    ]
