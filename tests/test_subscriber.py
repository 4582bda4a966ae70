"""Applications against a publisher that drops, misbehaves, refuses and comes back."""

import contextlib
import os
import re
import signal
import threading
import time
import zlib

import numpy as np
import pytest
import zmq

from ertis_numba.errors import ArgumentError, RefusedError
from ertis_numba.network import _subscription, messages
from ertis_numba.network.keys import AllowList, ClientKeys, KeyPair, ServerKeys
from ertis_numba.network.processing import Options, Processing
from ertis_numba.network.subscriber import Subscriber
from ertis_numba.pipeline import Pipeline
from tests.publishing import SETTINGS, Publisher, cloud, group, image, kind_of, measurement, status

ALL = ("energyscape", "points", "raw", "group", "status")
WAIT_S = 10.0


@pytest.fixture
def publisher():
    with Publisher() as made:
        yield made


@pytest.fixture
def hasty(monkeypatch):
    """Nobody has to wait long to see that somebody waits."""
    for name, time_s in {"_BEAT_S": 0.1, "_DEAD_S": 0.5, "_AGAIN_S": 0.1, "_UNMADE_S": 1.0}.items():
        monkeypatch.setattr(_subscription, name, time_s)


def subscribed(publisher, count=1):
    publisher.pump(lambda: len(publisher.peers) == count)


def got(publisher, subscriber):
    """Return what the subscriber receives next while the publisher serves."""
    items = []

    def came():
        item = subscriber.receive(0)
        items.extend([] if item is None else [item])
        return bool(items)

    publisher.pump(came)
    return items[0]


def consumed(publisher, count):
    publisher.pump(lambda: all(peer.wanted.consumed == count for peer in publisher.peers.values()))


def test_each_product_comes_as_it_was_sent(publisher):
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
        np.testing.assert_array_equal(came[0].energy, sent[0].energy)
        for name in ("azimuth_rad", "elevation_rad", "range_m"):
            np.testing.assert_array_equal(getattr(came[0], name), getattr(sent[0], name))
        np.testing.assert_array_equal(came[1].position_m, sent[1].position_m)
        np.testing.assert_array_equal(came[1].energy, sent[1].energy)
        np.testing.assert_array_equal(came[2].words, sent[2].words)
        assert [item.stamp for item in came[:3]] == [item.stamp for item in sent[:3]]
        assert [item.settings for item in came[:3]] == [SETTINGS] * 3
        assert came[1].translation_m == publisher.translation_m
        assert came[1].rotation_xyzw == publisher.rotation_xyzw
        assert came[3].sensors == ("front", "left")
        assert came[3].group == 6
        assert came[4] == sent[4]
        assert subscriber.latest.header.number == 4
        assert (subscriber.counts.received, subscriber.counts.missed, subscriber.counts.reconnects) == (5, 0, 0)


def test_what_came_with_a_product(publisher):
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


def test_images_of_half_precision_come_as_float32(publisher):
    half = image(reflectors=[(0, 1, 1.0)])
    half = half.replace(energy=half.energy.astype(np.float16))
    with Subscriber(publisher.address) as subscriber:
        subscribed(publisher)
        publisher.publish(half)
        came = got(publisher, subscriber)
    assert came.energy.dtype == np.float32
    np.testing.assert_array_equal(came.energy, half.energy.astype(np.float32))


def test_the_air_of_a_raw_measurement_is_its_own(publisher):
    with Subscriber(publisher.address, products=["raw"]) as subscriber:
        subscribed(publisher)
        publisher.publish(measurement(temperature_c=31.5))
        assert got(publisher, subscriber).settings.air.temperature_c == 31.5


def test_asks_for_some_sensors_and_products_only(publisher):
    with Subscriber(publisher.address, sensors=["left", "left"], products=["points"]) as subscriber:
        subscribed(publisher)
        (peer,) = publisher.peers.values()
        assert peer.wanted.sensors == ("left",)
        assert peer.wanted.products == ("points",)
        publisher.publish(cloud(1))
        publisher.publish(image(2, sensor="left"))
        publisher.publish(cloud(3, sensor="left"))
        assert got(publisher, subscriber).stamp.sequence == 3


def test_what_a_slow_application_has_no_credit_for_is_dropped_and_counted(publisher):
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


def test_what_was_not_taken_is_not_consumed_though_it_has_come(publisher):
    with Subscriber(publisher.address, credit=2) as subscriber:
        subscribed(publisher)
        publisher.publish(image(0))
        asked = len(publisher.heard)
        publisher.pump(lambda: len(publisher.heard) >= asked + 2)  # the next beat: subscribe and ping
        assert {message.consumed for message in publisher.heard if isinstance(message, messages.Subscribe)} == {0}
        got(publisher, subscriber)
        consumed(publisher, 1)


def test_a_publisher_that_comes_back_is_found_and_numbers_begin_anew(publisher):
    notes = []
    with Subscriber(publisher.address, on_note=notes.append) as subscriber:
        subscribed(publisher)
        for sequence in range(4):
            publisher.publish(image(sequence))
        got(publisher, subscriber)
        got(publisher, subscriber)
        consumed(publisher, 2)
        publisher.publish(image(4))
        got(publisher, subscriber)
        publisher.__exit__()
        # ZeroMQ connects again by itself, faster than any silence is noticed.
        with Publisher(address=publisher.address) as other:
            for sequence in range(50, 55):
                other.pump(lambda: other.peers and all(peer.has_room for peer in other.peers.values()))
                other.publish(image(sequence))
                assert got(other, subscriber).stamp.sequence == sequence
        counts = subscriber.counts
        assert (counts.received, counts.dropped, counts.missed, counts.reconnects) == (8, 2, 2, 1)
        assert notes[0] == "connected"


@pytest.mark.usefixtures("hasty")
def test_silence_ends_a_connection():
    notes = []
    with Publisher() as silent, Subscriber(silent.address, on_note=notes.append) as subscriber:
        silent.pump(lambda: subscriber.connected)
        silent.answers = False
        silent.pump(lambda: len(silent.peers) == 2)
        assert subscriber.counts.reconnects == 1
    assert notes == ["connected", "the publisher has been silent for 0.5 s; connecting again"]


@pytest.mark.usefixtures("hasty")
def test_no_images_are_no_silence_where_the_publisher_answers(publisher):
    with Subscriber(publisher.address) as subscriber:
        publisher.pump(lambda: sum(isinstance(message, messages.Ping) for message in publisher.heard) == 15)
        assert len(publisher.peers) == 1
        assert subscriber.counts.reconnects == 0


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda p: p.raw(b"\x00" * 40), "header begins with"),
        (lambda p: p.raw(messages.encode(messages.Ping())), "message is 'ping'"),
        (lambda p: p.publish(image(), shape=(31, 17)), r"image has shape \(31, 17\), its axes"),
        (lambda p: p.publish(image(), dtype="float16"), "31000 bytes came for float16"),
        (lambda p: p.publish(image(), description=9), "refers to description 9, which has not come"),
        (lambda p: p.publish(cloud(), n_points=2**60), "16 bytes came for float32 of shape"),
        (lambda p: p.publish(measurement(), crc32=1), "has another CRC-32 than its header"),
        (lambda p: p.tell_all(messages.Report(), b"\xff"), "status cannot be read"),
        (lambda p: p.tell_all(messages.Description(number=0, sensor="front")), "has 0 payloads; send settings and 3"),
        (
            lambda p: p.tell_all(messages.Description(number=0, sensor="front"), b"[", b"", b"", b""),
            "description cannot be used",
        ),
        (
            lambda p: p.tell_all(messages.Description(number=0, sensor="front"), b"", b"123", b"", b""),
            "an axis has 3 bytes",
        ),
    ],
)
def test_what_is_damaged_ends_the_connection_and_not_the_application(publisher, spoil, match):
    notes = []
    with Subscriber(publisher.address, products=ALL, on_note=notes.append) as subscriber:
        publisher.pump(lambda: subscriber.connected)
        spoil(publisher)
        publisher.pump(lambda: subscriber.counts.damaged == 1)
        publisher.peers.clear()
        subscribed(publisher)
        publisher.publish(image(8))
        assert got(publisher, subscriber).stamp.sequence == 8
    assert any(re.search(match, note) for note in notes), notes


def test_a_loop_ends_when_another_thread_closes(publisher):
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


def test_receive_gives_up_after_its_time(publisher):
    with Subscriber(publisher.address) as subscriber:
        assert subscriber.receive(0) is None
        assert subscriber.receive(0.01) is None


def test_waits_for_a_publisher_that_is_not_there_yet():
    with Publisher() as gone:
        address = gone.address
    with Subscriber(address) as subscriber:
        assert not subscriber.connected
        with Publisher(address=address) as late:
            subscribed(late)
            late.publish(image(4))
            assert got(late, subscriber).stamp.sequence == 4


@pytest.mark.usefixtures("hasty")
def test_refused_from_the_start_raises(publisher):
    def refuse():
        publisher.tell_all(messages.Refused(code="role", reason="key 'x' is of a sensor; give one of an application"))
        publisher.peers.clear()
        return came()

    def came():
        try:
            subscriber.receive(0)
        except RefusedError as error:
            raised.append(error)
        return bool(raised)

    raised = []
    with Subscriber(publisher.address) as subscriber:
        publisher.answers = False
        publisher.pump(refuse)
        assert f"{publisher.address}: key 'x' is of a sensor; give one of an application" in str(raised[0])
        with pytest.raises(RefusedError):
            subscriber.receive()


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    central, known, unknown = (KeyPair.new(name) for name in ("central", "known", "unknown"))
    listed = folder / "allow.toml"
    listed.write_text(f'[[keys]]\nname = "known"\npublic = "{known.public}"\nrole = "application"\n')
    assert AllowList.load(listed).find(known.public)
    return {
        "server": ServerKeys(central, listed),
        "known": ClientKeys(known, central.public),
        "unknown": ClientKeys(unknown, central.public),
        "wrong server": ClientKeys(known, unknown.public),
        "none": None,
    }


def test_with_keys(keys):
    with Publisher(keys=keys["server"]) as publisher, Subscriber(publisher.address, keys=keys["known"]) as subscriber:
        subscribed(publisher)
        publisher.publish(image(2))
        assert got(publisher, subscriber).stamp.sequence == 2


@pytest.mark.parametrize(
    ("who", "match"),
    [
        ("unknown", "the central node does not know this key"),
        ("none", "wants a key.* give --key and --server-key"),
        ("wrong server", "server-key"),
    ],
)
@pytest.mark.usefixtures("hasty")
def test_who_is_not_let_in_is_told_so(keys, who, match):
    with Publisher(keys=keys["server"]) as publisher, publisher.playing([image()]):
        with Subscriber(publisher.address, keys=keys[who]) as subscriber, pytest.raises(RefusedError, match=match):
            subscriber.receive(WAIT_S)
        assert not publisher.peers


def offered(processing, subscriber, sequences):
    """Return the images of measurements that a real central node's processing is given one after the other."""
    came = []
    for sequence in sequences:
        given = measurement(sequence)
        data = messages.Data(
            sensor="front",
            epoch=7,
            sequence=sequence,
            sync_count=sequence,
            timestamp_ns=given.stamp.timestamp_ns,
            uncertainty_ns=900,
            monotonic_ns=time.monotonic_ns(),
            **{name: getattr(SETTINGS.air, name) for name in ("temperature_c", "humidity_percent", "pressure_pa")},
            crc32=zlib.crc32(given.words.data),
        )
        processing.offer(data, given.words, time.monotonic_ns())
        turned(processing, lambda: [came.append(subscriber.receive(0)), came[-1]][-1] is not None)
    return [item for item in came if item is not None]


def turned(processing, until):
    end_s = time.monotonic() + 60
    while not until():
        assert time.monotonic() < end_s, "it did not come to that"
        poller = zmq.Poller()
        for fd in processing.fds():
            poller.register(fd, zmq.POLLIN)
        for fd, _ in poller.poll(5):
            processing.ready(fd)
        processing.tick(time.monotonic())


def test_images_of_a_real_publisher_which_dies_and_comes_back(keys):
    processing = Processing(Options(publish="tcp://127.0.0.1:0", keys=keys["server"], device="cpu", workers=1))
    processing.start()
    with contextlib.closing(processing), Subscriber(processing.address, keys=keys["known"]) as subscriber:
        processing.know(messages.Hello(sensor="front", epoch=7, next_sequence=0, settings_crc32=0), SETTINGS)
        turned(processing, lambda: processing.status().subscribers)
        images = offered(processing, subscriber, range(3))
        # Whoever kills it must know it: it is nobody's business otherwise.
        os.kill(processing._publisher._child.pid, signal.SIGKILL)  # noqa: SLF001
        turned(processing, lambda: processing.status().publisher_respawned == 1)
        turned(processing, lambda: processing.status().subscribers)
        images += offered(processing, subscriber, range(3, 6))
        assert [each.stamp.sequence for each in images] == list(range(6))
        assert (subscriber.counts.received, subscriber.counts.missed, subscriber.counts.reconnects) == (6, 0, 1)
    with Pipeline(SETTINGS, device="cpu") as pipeline:
        expected = pipeline.process(measurement(5))
    np.testing.assert_array_equal(images[5].energy, expected.energy)
    np.testing.assert_array_equal(images[5].range_m, expected.range_m)
    assert images[5].stamp == measurement(5).stamp


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"address": "127.0.0.1:5602"}, "address '127.0.0.1:5602' cannot be used"),
        ({"address": "tcp://10.0.0.1:5602"}, "can be reached from other machines, and there are no keys"),
        ({"products": ["pictures"]}, "product 'pictures' is unknown"),
        ({"products": []}, "products are none; give some of energyscape"),
        ({"sensors": []}, "sensors are 0; give 1 to 32"),
        ({"sensors": ["a b"]}, "sensor name 'a b' cannot stand"),
        ({"credit": 65}, "credit is 65; give a whole number from 1 to 64"),
    ],
)
def test_refuses(arguments, match):
    with pytest.raises(ArgumentError, match=match):
        Subscriber(**{"address": "tcp://127.0.0.1:1"} | arguments)
