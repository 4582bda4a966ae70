"""Applications and a publisher: each product arrives unchanged, within the credit."""

import threading
import time

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.network import messages
from ertis_numba.network.subscriber import Subscriber
from tests.publishing import (
    ALL,
    SETTINGS,
    Publisher,
    cloud,
    consumed,
    got,
    group,
    image,
    kind_of,
    measurement,
    status,
    subscribed,
)

WAIT_S = 60.0


@pytest.fixture
def publisher():
    with Publisher() as made:
        yield made


def test_each_product_arrives_unchanged(publisher):
    sent = [
        image(3, reflectors=[(10, 1, 0.5)]),
        cloud(4),
        measurement(5),
        group(6, "front", "left"),
        status(uptime_s=99.0),
    ]
    with Subscriber(publisher.address, products=ALL) as subscriber:
        subscribed(publisher)
        came = []
        for item in sent:
            publisher.publish(item)
            came.append(got(publisher, subscriber))
            consumed(publisher, len(came))
        assert [kind_of(item) for item in came] == list(ALL)
        np.testing.assert_array_equal(came[0].amplitude, sent[0].amplitude)
        for name in ("azimuth_rad", "elevation_rad", "range_m"):
            np.testing.assert_array_equal(getattr(came[0], name), getattr(sent[0], name))
        np.testing.assert_array_equal(came[1].position_m, sent[1].position_m)
        np.testing.assert_array_equal(came[1].amplitude, sent[1].amplitude)
        np.testing.assert_array_equal(came[2].data, sent[2].data)
        assert [item.stamp for item in came[:3]] == [item.stamp for item in sent[:3]]
        assert [item.settings for item in came[:3]] == [SETTINGS] * 3
        assert came[1].translation_m == publisher.translation_m
        assert came[1].rotation_xyzw == publisher.rotation_xyzw
        assert came[3].sensors == ("front", "left")
        assert came[3].group == 6
        assert came[4] == sent[4]
        assert subscriber.latest.header.number == 4
        assert (subscriber.counts.received, subscriber.counts.missed, subscriber.counts.reconnects) == (5, 0, 0)


def test_product_carries_its_metadata(publisher):
    with Subscriber(publisher.address) as subscriber:
        subscribed(publisher)
        assert subscriber.latest is None
        publisher.publish(image(timestamp_ns=time.time_ns() - 250_000_000))
        item, latest = got(publisher, subscriber), subscriber.latest
        assert latest.item is item
        assert latest.made_in_s == pytest.approx(0.012)
        assert 0.25 <= latest.age_s < WAIT_S
        assert latest.translation_m == publisher.translation_m
        assert latest.rotation_xyzw == publisher.rotation_xyzw
        assert latest.header.monotonic_ns == 5
        publisher.publish(image(timestamp_ns=3_000_000_000))  # of a clock that was not set
        got(publisher, subscriber)
        assert subscriber.latest.age_s is None


def test_half_precision_images_arrive_as_float32(publisher):
    half = image(reflectors=[(0, 1, 1.0)])
    half = half.replace(amplitude=half.amplitude.astype(np.float16))
    with Subscriber(publisher.address) as subscriber:
        subscribed(publisher)
        publisher.publish(half)
        came = got(publisher, subscriber)
    assert came.amplitude.dtype == np.float32
    np.testing.assert_array_equal(came.amplitude, half.amplitude.astype(np.float32))


def test_levels_arrive_as_float32_with_their_step(publisher):
    """Each image has its own scale."""
    codes = image().replace(amplitude=np.resize(np.arange(256, dtype=np.uint8), image().amplitude.shape))
    with Subscriber(publisher.address) as subscriber:
        subscribed(publisher)
        for floor_db, step_db in ((-122.0, 0.5), (-90.0, 0.25)):
            publisher.publish(codes, floor_db=floor_db, step_db=step_db)
            came = got(publisher, subscriber)
            assert (came.amplitude.dtype, came.level_step_db) == (np.float32, step_db)
            heard = codes.amplitude > 0
            found_db = 20 * np.log10(came.amplitude[heard])
            np.testing.assert_allclose(found_db, floor_db + step_db * (codes.amplitude[heard] - 1.0), atol=1e-4)
            assert not came.amplitude[~heard].any()


def test_raw_measurement_keeps_its_own_air(publisher):
    with Subscriber(publisher.address, products=["raw"]) as subscriber:
        subscribed(publisher)
        publisher.publish(measurement(temperature_c=31.5))
        assert got(publisher, subscriber).settings.air.temperature_c == 31.5


def test_subscriber_requests_selected_sensors_and_products(publisher):
    with Subscriber(publisher.address, sensors=["left", "left"], products=["points"]) as subscriber:
        subscribed(publisher)
        (peer,) = publisher.peers.values()
        assert peer.wanted.sensors == ("left",)
        assert peer.wanted.products == ("points",)
        publisher.publish(cloud(1))
        publisher.publish(image(2, sensor="left"))
        publisher.publish(cloud(3, sensor="left"))
        assert got(publisher, subscriber).stamp.sequence == 3


def test_products_beyond_the_credit_are_dropped_and_counted(publisher):
    with Subscriber(publisher.address, credit=2) as subscriber:
        subscribed(publisher)
        for sequence in range(10):
            publisher.publish(image(sequence))
        assert [got(publisher, subscriber).stamp.sequence for _ in range(2)] == [0, 1]
        consumed(publisher, 2)
        publisher.publish(image(10))
        assert got(publisher, subscriber).stamp.sequence == 10
        counts = subscriber.counts
        assert (counts.received, counts.dropped, counts.missed) == (3, 8, 8)


def test_unread_products_are_not_reported_as_consumed(publisher):
    with Subscriber(publisher.address, credit=2) as subscriber:
        subscribed(publisher)
        publisher.publish(image(0))
        asked = len(publisher.heard)
        publisher.pump(lambda: len(publisher.heard) >= asked + 2)  # the next beat: subscribe and ping
        assert {message.consumed for message in publisher.heard if isinstance(message, messages.Subscribe)} == {0}
        got(publisher, subscriber)
        consumed(publisher, 1)


def test_loop_ends_when_another_thread_closes_the_subscriber(publisher):
    came = []
    with Subscriber(publisher.address) as subscriber:
        subscribed(publisher)
        publisher.publish(image(1))
        closer = threading.Thread(target=lambda: (first.wait(WAIT_S), subscriber.close()))
        first = threading.Event()
        closer.start()
        for item in subscriber:
            came.append(item.stamp.sequence)
            first.set()
        closer.join()
        assert subscriber.receive() is None  # and stays so
        subscriber.close()
    assert came == [1]
    publisher.pump(lambda: not publisher.peers)  # it has said that it leaves
    assert "ertis-subscriber" not in {thread.name for thread in threading.enumerate()}


def test_receive_returns_after_its_timeout(publisher):
    with Subscriber(publisher.address) as subscriber:
        assert subscriber.receive(0) is None
        assert subscriber.receive(0.01) is None


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"address": "127.0.0.1:5602"}, "address '127.0.0.1:5602' cannot be used"),
        ({"address": "tcp://10.0.0.1:5602"}, "can be reached from other machines, but there are no keys"),
        ({"products": ["pictures"]}, "product 'pictures' is unknown"),
        ({"products": []}, "products is empty; choose from energyscape, points, raw, group, status"),
        ({"sensors": []}, "sensors lists 0 names; use 1 to 32, or None for all"),
        ({"sensors": ["a b"]}, "sensor name 'a b' cannot name a group"),
        ({"credit": 65}, "credit is 65; use a whole number from 1 to 64"),
    ],
)
def test_invalid_arguments_are_refused(arguments, match):
    with pytest.raises(ArgumentError, match=match):
        Subscriber(**{"address": "tcp://127.0.0.1:1"} | arguments)
