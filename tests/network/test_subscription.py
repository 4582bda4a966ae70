"""Applications and a publisher that ends, is silent, refuses, damages messages, and returns."""

import contextlib
import os
import re
import signal
import time
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
import zmq

from ertis_numba.base.errors import RefusedError
from ertis_numba.network import _subscription, connection, messages, subscriber as subscriber_module
from ertis_numba.network.allow_list import AllowList
from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys
from ertis_numba.network.processing import ImageProcessing, ProcessingOptions
from ertis_numba.network.subscriber import Subscriber
from ertis_numba.pipeline import Pipeline
from tests.driven import TIMEOUT_S
from tests.ports import reserved_address
from tests.publishing import (
    ALL,
    SETTINGS,
    Publisher,
    cloud,
    consumed,
    got,
    image,
    measurement,
    subscribed,
)

WAIT_S = 60.0


def levels_of(given):
    """An image of 8-bit codes, without their scale."""
    return given.replace(amplitude=np.full(given.amplitude.shape, 9, np.uint8))


@pytest.fixture
def publisher():
    with Publisher() as made:
        yield made


@pytest.fixture
def hasty(monkeypatch):
    """Shorten the waiting times, but do not mistake a busy machine for a silent publisher."""
    monkeypatch.setattr(connection, "PING_INTERVAL_S", 0.1)
    for name, time_s in {"SILENCE_LIMIT_S": WAIT_S, "_AGAIN_S": 0.1, "_UNMADE_S": 1.0}.items():
        monkeypatch.setattr(_subscription, name, time_s)


def test_restarted_publisher_is_found_and_numbers_restart():
    notes = []
    with (
        reserved_address() as address,
        Publisher(address=address) as publisher,
        Subscriber(address, on_note=notes.append) as subscriber,
    ):
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
        with Publisher(address=address) as other:
            for sequence in range(50, 55):
                other.pump(lambda: other.peers and all(peer.has_room for peer in other.peers.values()))
                other.publish(image(sequence))
                assert got(other, subscriber).stamp.sequence == sequence
        counts = subscriber.counts
        assert (counts.received, counts.dropped, counts.missed, counts.reconnects) == (8, 2, 2, 1)
        assert notes[0] == "connected"


@pytest.mark.usefixtures("hasty")
def test_silence_ends_a_connection(monkeypatch):
    notes = []
    with Publisher() as silent, Subscriber(silent.address, on_note=notes.append) as subscriber:
        silent.pump(lambda: subscriber.connected)
        silent.answers = False
        monkeypatch.setattr(_subscription, "SILENCE_LIMIT_S", 0.5)
        silent.pump(lambda: len(silent.peers) == 2)
        assert subscriber.counts.reconnects == 1
    assert notes == ["connected", "the publisher has been silent for 0.5 s; connecting again"]


@pytest.mark.usefixtures("hasty")
def test_answering_publisher_without_images_is_not_silent(publisher, monkeypatch):
    """The clock advances by 0.4 s after each answer; the limit of silence is 0.5 s."""
    clock = SimpleNamespace(now_s=1.0, monotonic=lambda: clock.now_s, monotonic_ns=time.monotonic_ns)
    for module in (connection, _subscription, subscriber_module):
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(_subscription, "SILENCE_LIMIT_S", 0.5)
    with Subscriber(publisher.address) as subscriber:
        for _ in range(5):
            publisher.pump(lambda: _heard_s(subscriber) == clock.now_s)
            clock.now_s += 0.4
        assert len(publisher.peers) == 1
        assert subscriber.counts.reconnects == 0


def _heard_s(subscriber):
    """Return the time of the last answer on the clock of a subscriber."""
    made = subscriber._subscription._connection  # noqa: SLF001
    return None if made is None else made.heard_s


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda p: p.raw(b"\x00" * 40), "header begins with"),
        (lambda p: p.raw(messages.encode(messages.Ping())), "message is 'ping'"),
        (lambda p: p.publish(image(), shape=(31, 17)), r"image has shape \(31, 17\), but its axes"),
        (lambda p: p.publish(image(), dtype="float16"), "77500 bytes arrived for float16"),
        (lambda p: p.publish(levels_of(image())), "an image has 8-bit levels from None dB in steps of None dB"),
        (lambda p: p.publish(levels_of(image()), floor_db=0.0, step_db=-1.0), "from 0.0 dB in steps of -1.0 dB; state"),
        (lambda p: p.publish(image(), description=9), "refers to description 9, which has not arrived"),
        (lambda p: p.publish(cloud(), n_points=2**60), "16 bytes arrived for float32 of shape"),
        (lambda p: p.publish(measurement(), crc32=1), "does not match the CRC-32 in its header"),
        (lambda p: p.tell_all(messages.Report(), b"\xff"), "status cannot be decoded"),
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
def test_damaged_messages_end_the_connection_only(publisher, spoil, match):
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


def test_subscriber_waits_for_a_publisher():
    with reserved_address() as address, Subscriber(address) as subscriber:
        assert not subscriber.connected
        with Publisher(address=address) as late:
            subscribed(late)
            late.publish(image(4))
            assert got(late, subscriber).stamp.sequence == 4


@pytest.mark.usefixtures("hasty")
def test_first_refusal_raises(publisher):
    def refuse():
        publisher.tell_all(messages.Refused(code="role", reason="key 'x' is of a sensor; choose one of an application"))
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
        assert f"{publisher.address}: key 'x' is of a sensor; choose one of an application" in str(raised[0])
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


def test_subscriber_with_keys_receives_products(keys):
    with Publisher(keys=keys["server"]) as publisher, Subscriber(publisher.address, keys=keys["known"]) as subscriber:
        subscribed(publisher)
        publisher.publish(image(2))
        assert got(publisher, subscriber).stamp.sequence == 2


@pytest.mark.parametrize(
    ("who", "match"),
    [
        ("unknown", "the central node does not know this key"),
        ("none", "requires a key[;,] set one"),
        ("wrong server", r"pass its key \(server\)"),
    ],
)
@pytest.mark.usefixtures("hasty")
def test_refused_subscriber_gets_the_reason(keys, who, match):
    with Publisher(keys=keys["server"]) as publisher, publisher.playing([image()]):
        with Subscriber(publisher.address, keys=keys[who]) as subscriber, pytest.raises(RefusedError, match=match):
            subscriber.receive(WAIT_S)
        assert not publisher.peers


def offered(processing, subscriber, sequences):
    """Return the images of measurements that a real central node processes one after the other."""
    came = []
    for sequence in sequences:
        given = measurement(sequence)
        data = messages.Data(
            sensor="front",
            session_id=7,
            sequence=sequence,
            sync_count=sequence,
            timestamp_ns=given.stamp.timestamp_ns,
            uncertainty_ns=900,
            monotonic_ns=time.monotonic_ns(),
            **{name: getattr(SETTINGS.air, name) for name in ("temperature_c", "humidity_percent", "pressure_pa")},
            crc32=zlib.crc32(given.data.data),
        )
        processing.offer(data, given.data, time.monotonic_ns())
        turned(processing, lambda: [came.append(subscriber.receive(0)), came[-1]][-1] is not None)
    return [item for item in came if item is not None]


def turned(processing, until):
    end_s = time.monotonic() + TIMEOUT_S
    while not until():
        assert time.monotonic() < end_s, "it did not come to that"
        poller = zmq.Poller()
        for fd in processing.fds():
            poller.register(fd, zmq.POLLIN)
        for fd, _ in poller.poll(5):
            processing.ready(fd)
        processing.tick(time.monotonic())


def test_images_continue_after_a_publisher_restart(keys):
    processing = ImageProcessing(
        ProcessingOptions(
            publish="tcp://127.0.0.1:0", keys=keys["server"], device="numpy", workers=1, deadline_s=TIMEOUT_S
        )
    )
    processing.start()
    with contextlib.closing(processing), Subscriber(processing.address, keys=keys["known"]) as subscriber:
        processing.register(messages.Hello(sensor="front", session_id=7, next_sequence=0, settings_crc32=0), SETTINGS)
        turned(processing, lambda: processing.status().subscribers)
        images = offered(processing, subscriber, range(3))
        # Whoever kills it must know it: it is nobody's business otherwise.
        os.kill(processing._publisher.pid, signal.SIGKILL)  # noqa: SLF001
        turned(processing, lambda: processing.status().publisher_respawned == 1)
        turned(processing, lambda: processing.status().subscribers)
        images += offered(processing, subscriber, range(3, 6))
        assert [each.stamp.sequence for each in images] == list(range(6))
        assert (subscriber.counts.received, subscriber.counts.missed, subscriber.counts.reconnects) == (6, 0, 1)
    with Pipeline(SETTINGS, device="numpy") as pipeline:
        expected = pipeline.process(measurement(5))
    # Sums of BLAS differ in the last digits between numbers of threads.
    np.testing.assert_allclose(images[5].amplitude, expected.amplitude, rtol=1e-5)
    np.testing.assert_array_equal(images[5].range_m, expected.range_m)
    assert images[5].stamp == measurement(5).stamp
