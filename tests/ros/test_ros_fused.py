"""Points of several sensors, fused in the frame of their platform."""

from dataclasses import replace

import numpy as np
import pytest

from ertis_numba.frames import PointCloud, Stamp
from ertis_numba.fusion import Fuser
from ertis_numba.interop.ros_messages import MESSAGES, points_message
from ertis_numba.interop.scans import reflectors_ahead, scan_message
from ertis_numba.ros import Participant, PublishingSettings, RosPublisher
from ertis_numba.ros.fused_points import FusedImages, FusedPoints, joined
from ertis_numba.settings import Settings
from tests.ros.test_ros import equal, stamped
from tests.ros_topics import DOMAIN, await_subscribers, subscribed

TIME_NS = 1_700_000_000_000_000_000
PERIOD_NS = 50_000_000
AHEAD = ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
LEFT = ((0.0, 0.5, 0.2), (0.0, 0.0, 0.5**0.5, 0.5**0.5))
"""Mounting of a sensor that looks to the left."""


def cloud(sensor, count, *, place=AHEAD, n_points=2, later_ns=0):
    position_m = np.arange(3 * n_points, dtype=np.float32).reshape(n_points, 3) + 1
    return PointCloud(
        position_m=position_m,
        amplitude=np.linspace(1.0, 0.5, n_points, dtype=np.float32),
        settings=Settings(),
        stamp=Stamp(sensor=sensor, sync_count=count, timestamp_ns=TIME_NS + count * PERIOD_NS + later_ns),
        translation_m=place[0],
        rotation_xyzw=place[1],
    )


def counts(groups):
    """SYNC count and number of points of each group."""
    return [(group.stamp.sync_count, len(group)) for group in groups]


def test_points_are_joined_in_the_frame_of_the_platform():
    front, left = cloud("front", 3, later_ns=4_000), cloud("left", 3, place=LEFT, n_points=1)
    left = left.replace(uncertainty_m=np.full((1, 2), 0.01, np.float32))
    both = joined({"front": front, "left": left})
    np.testing.assert_allclose(both.position_m, [[2, 2, 3], [5, 5, 6], [-2, 1.5, 3.2]], rtol=1e-6)
    assert both.on_platform_m() == pytest.approx(both.position_m)
    assert both.stamp == replace(left.stamp, sensor="base_link")
    assert np.isnan(both.uncertainty_m[:2]).all()
    assert both.uncertainty_m[2] == pytest.approx([0.01, 0.01])
    assert both.amplitude.tolist() == [1.0, 0.5, 1.0]


def test_mountings_may_be_arrays_as_recordings_return_them():
    place = (np.array([0.0, 0.5, 0.2]), np.array([0.0, 0.0, 0.0, 1.0]))
    assert joined({"left": cloud("left", 3, place=place, n_points=1)}).position_m.tolist() == [
        [1.0, 2.5, pytest.approx(3.2)]
    ]


def test_group_is_returned_once_all_expected_sensors_are_there():
    fused = FusedPoints()
    assert counts(fused.add(cloud("front", 0))) == [(0, 2)]  # Nobody else is known.
    assert counts(fused.add(cloud("left", 0))) == []  # Its group was returned; from now on it is expected.
    for count in range(1, 4):
        assert fused.add(cloud("front", count)) == []
        assert counts(fused.add(cloud("left", count))) == [(count, 4)]


def test_missing_sensor_delays_one_group_only():
    fused = FusedPoints()
    fused.add(cloud("front", 0)), fused.add(cloud("left", 0))
    assert fused.add(cloud("front", 1)) == []
    assert counts(fused.add(cloud("front", 2))) == [(1, 2), (2, 2)]
    assert counts(fused.add(cloud("front", 3))) == [(3, 2)]
    assert fused.add(cloud("left", 3)) == []
    assert fused.add(cloud("front", 4)) == []
    assert counts(fused.add(cloud("left", 4))) == [(4, 4)]


def test_equal_counts_of_different_times_are_different_pulses():
    fused = FusedPoints()
    fused.add(cloud("front", 0)), fused.add(cloud("left", 0))
    assert fused.add(cloud("front", 7)) == []
    (alone,) = fused.add(cloud("left", 7, later_ns=10**9))
    assert (alone.stamp.timestamp_ns, len(alone)) == (TIME_NS + 7 * PERIOD_NS, 2)
    (other,) = fused.add(cloud("front", 8, later_ns=10**9))
    assert (other.stamp.timestamp_ns, len(other)) == (TIME_NS + 7 * PERIOD_NS + 10**9, 2)


def test_fused_points_arrive_in_rclpy():
    images = {"front": stamped(1, "front"), "left": stamped(2, "left")}
    places = {"front": AHEAD, "left": LEFT}
    kinds = {"/robot1/fused/points": MESSAGES["points"], "/robot1/fused/scan": MESSAGES["scan"]}
    with Participant(domain=DOMAIN) as participant:
        publisher = RosPublisher(participant, topics=["points", "scan"], namespace="robot1")
        for sequence in range(2):
            for name, each in images.items():
                publisher.publish(each.replace(stamp=replace(each.stamp, sync_count=sequence)), places[name])
        with subscribed(kinds) as subscriber:
            await_subscribers([publisher.topics[name] for name in kinds])
            for name, each in images.items():
                publisher.publish(each.replace(stamp=replace(each.stamp, sync_count=2)), places[name])
            taken = {name: each[0] for name, each in subscriber.take(2).items()}
            publisher.publish(stamped(3, "fused"))
            assert "/robot1/fused_2/points" in publisher.topics
    same = [each.replace(stamp=replace(each.stamp, sync_count=2)) for each in images.values()]
    fuser = Fuser(places)
    fuser(same[1:])  # The first pulse that is fused has no image of the front, and determines the last range.
    wanted = fuser(same)
    cloud = wanted.points.strongest(256, -20.0)
    assert equal(taken["/robot1/fused/points"], points_message(cloud), MESSAGES["points"])
    scan = scan_message(wanted.image)
    assert equal(taken["/robot1/fused/scan"], scan, MESSAGES["scan"])


@pytest.mark.parametrize("origin_m", [(0.0, 0.0, 0.0), (500_000.0, 4_000_000.0, 0.0)])
def test_fused_images_have_the_points_of_the_fuser(origin_m):
    given = {"front": stamped(1, "front"), "left": stamped(2, "left")}
    x_m, y_m, z_m = origin_m
    places = {
        name: ((x + x_m, y + y_m, z + z_m), turn) for name, ((x, y, z), turn) in {"front": AHEAD, "left": LEFT}.items()
    }
    fusing, made = FusedImages(), []
    for sequence in range(2):
        for each in given.values():
            made += fusing.add(each.replace(stamp=replace(each.stamp, sync_count=sequence)), places)
    wanted = Fuser({"front": AHEAD, "left": LEFT})([*given.values()]).points
    made = [fused for fused, _ in made]
    offset_m = np.subtract(made[-1].points.translation_m, origin_m)
    assert np.all(np.abs(offset_m) < 2)
    assert np.all(offset_m == np.round(offset_m))
    found_m, wanted_m = (  # In the order of x, since both points are equally strong.
        each_m[np.argsort(each_m[:, 0])] for each_m in (made[-1].points.position_m + offset_m, wanted.position_m)
    )
    np.testing.assert_allclose(found_m, wanted_m, atol=1e-5)
    assert made[-1].stamp.sensor == ("base_link_local" if any(origin_m) else "base_link")


def test_reflectors_ahead_of_a_sensor_are_in_its_frame():
    given = cloud("base_link", 0, n_points=4).replace(
        position_m=np.float32([[0.0, 2.0, 0.2], [1.0, 1.5, 0.2], [0.0, -3.0, 0.2], [0.5, 4.0, 0.2]]),
        confirmed=np.array([True, True, True, False]),
    )
    ahead = reflectors_ahead(given, stamped(2, "left"), LEFT)
    # Behind the sensor is the third one; the fourth is neither confirmed nor the nearest.
    np.testing.assert_allclose(ahead.position_m, [[1.5, 0.0, 0.0], [1.0, -1.0, 0.0]], atol=1e-6)
    assert ahead.stamp.sensor == "left"
    unsure = reflectors_ahead(given.replace(confirmed=np.zeros(4, bool)), stamped(2, "left"), LEFT)
    np.testing.assert_allclose(unsure.position_m, [[1.0, -1.0, 0.0]], atol=1e-6)  # the nearest to the platform


def test_scans_of_the_sensors_of_a_platform_show_fused_reflectors():
    given, places = {"front": stamped(1, "front"), "left": stamped(2, "left")}, {"front": AHEAD, "left": LEFT}
    participant = Recorded()
    publisher = RosPublisher(participant, topics=["scan"])
    for count in range(2):
        for name, each in given.items():
            publisher.publish(each.replace(stamp=replace(each.stamp, sync_count=count)), places[name])
    same = {name: each.replace(stamp=replace(each.stamp, sync_count=1)) for name, each in given.items()}
    fuser = Fuser(places)
    fuser([same["left"]])
    points = fuser(same.values()).points
    for name, each in same.items():
        wanted = scan_message(each.replace(points=reflectors_ahead(points, each, places[name])))
        assert participant.topics[f"/{name}/scan"].messages[-1] == wanted
    # The first image is alone. The second one begins the fusion, and the last two complete a pulse.
    assert {name: len(each.messages) for name, each in participant.topics.items()} == {
        "/front/scan": 2,
        "/left/scan": 2,
        "/fused/scan": 2,
    }


def test_sensors_without_mounting_are_not_fused():
    with Participant(domain=DOMAIN) as participant:
        publisher = RosPublisher(participant, topics=["points"])
        for count in range(3):
            publisher.publish(stamped(1, "front", count), AHEAD)
            publisher.publish(stamped(2, "left", count))
        assert "/fused/points" not in publisher.topics


class RecordedTopic:
    """A topic that keeps its messages."""

    def __init__(self):
        self.messages = []
        self.publish = self.messages.append


class Recorded:
    """A participant whose topics keep their messages."""

    def __init__(self):
        self.topics = {}

    def topic(self, name, _message, *, latched):
        return self.topics.setdefault(name, RecordedTopic()) if not latched else RecordedTopic()


def test_rates_are_limited_after_fusing():
    """A limit before fusing would leave out other pulses of one sensor than of the other."""
    participant = Recorded()
    publisher = RosPublisher(
        participant, topics=["points"], settings=PublishingSettings(max_rate_hz={"points": 5.0}), namespace="robot1"
    )
    given = [("front", AHEAD, count) for count in range(41)]
    given += [("left", LEFT, count) for count in range(1, 41)]  # begins one pulse later
    for name, place, count in sorted(given, key=lambda each: each[2]):
        publisher.publish(cloud(name, count, place=place), place)
    messages = {name.removeprefix("/robot1/"): topic.messages for name, topic in participant.topics.items()}
    # 20 Hz for two seconds, at 5 Hz.
    assert {name: len(each) for name, each in messages.items()} == {
        "front/points": 11,
        "left/points": 10,
        "fused/points": 10,
    }
    assert {message["width"] for message in messages["fused/points"][1:]} == {4}
    assert publisher.left_out == 30 + 30 + 30
    assert publisher.published == 11 + 10 + 1  # One fused message is sent when no message of a sensor is due.
