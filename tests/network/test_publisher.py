"""Publisher and its applications: credit, latest images, exact counts and access rights."""

import os
import signal
import time
from collections import Counter
from contextlib import ExitStack

import numpy as np
import pytest
import zmq

from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys
from ertis_numba.network.messages import AskStatus, Bye, Image, Ping, Pong, Raw, Refused, Report, Subscribe, encode
from ertis_numba.network.processing.subscribers import ConnectedSubscriber, QueuedProduct, Subscribers
from ertis_numba.network.status import Status
from tests.driven import SHORT, Application, driven, hello


@pytest.fixture
def application(loop):
    """Connect an application after the sensor ``front`` was registered; no other application is connected."""
    loop.until(lambda: loop.workers("idle"))
    loop.until(lambda: not loop.processing.status().subscribers)
    with Application(loop.processing.address) as application:
        loop.processing.register(hello(), SHORT)
        yield application


def subscribed(loop, application, *products, **values):
    application.subscribe(*products, **values)
    loop.until(lambda: application.read() or any(isinstance(other, Pong) for other in application.others))


def publish(loop, count, sensor="front"):
    for _ in range(count):
        loop.offer(sensor)
        loop.settle()


def test_latest_image_waits_for_credit(loop, application):
    loop.processing.register(hello("slow"), SHORT)
    subscribed(loop, application, "energyscape", credit=2)
    publish(loop, 7, "slow")
    loop.until(lambda: application.read() or len(application.got) == 2)
    application.consumed = 1
    application.subscribe("energyscape", credit=2)
    loop.until(lambda: application.read() or len(application.got) == 3)
    reported = loop.processing.status
    loop.until(lambda: reported().subscribers and reported().subscribers[0].sent == 3)
    (status,) = reported().subscribers
    images = [image for image, _ in application.got]
    assert [(image.sequence, image.number, image.dropped) for image in images] == [(0, 0, 0), (1, 1, 0), (6, 6, 4)]
    assert (status.sent, status.dropped, status.products) == (3, 4, ("energyscape",))
    assert loop.processing.counts("slow").published == 7  # A slow application causes no drops for others.


def test_each_product_of_each_sensor_waits_separately(loop, application):
    loop.processing.register(hello("left"), SHORT)
    subscribed(loop, application, "raw", "energyscape", credit=1)
    for sensor in ("front", "left", "front", "left"):
        loop.offer(sensor)
        loop.settle()
    for consumed in range(1, 6):
        application.consumed = consumed
        application.subscribe("raw", "energyscape", credit=1)
        loop.until(lambda consumed=consumed: application.read() or len(application.got) == min(consumed + 1, 5))
    got = [(type(message), message.sensor, message.sequence, message.number) for message, _ in application.got]
    assert got == [
        (Image, "front", 0, 0),
        (Image, "front", 2, 4),
        (Raw, "front", 2, 5),
        (Image, "left", 3, 6),
        (Raw, "left", 3, 7),
    ]
    assert [message.dropped for message, _ in application.got][-1] == 3


def test_only_subscribed_sensors_and_products_are_sent(loop, application):
    loop.processing.register(hello("left"), SHORT)
    subscribed(loop, application, "energyscape", sensors=("left",), credit=8)
    for sensor in ("front", "left"):
        loop.offer(sensor)
    loop.settle()
    loop.until(lambda: application.read() or application.got)
    assert [(type(message), message.sensor) for message, _ in application.got] == [(Image, "left")]


def test_killed_publisher_restarts_and_its_images_are_counted(loop, application):
    loop.processing.register(hello("killed"), SHORT)
    before = loop.processing.status()
    subscribed(loop, application, "energyscape", credit=64)
    publisher = loop.processing.status().publisher_pid
    os.kill(publisher, signal.SIGSTOP)
    loop.offer("killed")
    loop.until(lambda: loop.processing.status().workers[0].done == before.workers[0].done + 1)
    os.kill(publisher, signal.SIGKILL)
    loop.settle()
    counts = loop.processing.counts("killed")
    assert (counts.published, counts.dropped) == (0, {"the publisher died": 1})
    loop.until(lambda: loop.processing.status().publisher_pid not in {0, publisher})
    application.others.clear()
    loop.until(lambda: application.subscribe("energyscape", credit=64) or application.read() or application.others)
    publish(loop, 1)
    loop.until(lambda: application.read() or application.got)
    assert loop.processing.status().publisher_respawned == before.publisher_respawned + 1
    assert [image.sequence for image, _ in application.got] == [1]


def test_restarted_publisher_keeps_its_address(tmp_path):
    central, viewer = KeyPair.new("central"), KeyPair.new("viewer")
    AllowList().save(tmp_path / "allow.toml")
    with driven(publish="tcp://0.0.0.0:0", keys=ServerKeys(central, tmp_path / "allow.toml")) as loop:
        publisher = loop.processing.status().publisher_pid
        os.kill(publisher, signal.SIGKILL)
        loop.until(lambda: loop.processing.status().publisher_pid not in {0, publisher})
        elsewhere = loop.processing.address.replace("127.0.0.1", "127.0.0.2")  # Another address of this machine.
        with Application(elsewhere, ClientKeys(viewer, central.public)):
            loop.until(lambda: loop.processing.refused.get("unknown key"))


@pytest.mark.alone  # An application delayed by a busy machine loses its subscription.
def test_sensor_may_change_its_settings_often(loop, application):
    respawned = loop.processing.status().publisher_respawned
    subscribed(loop, application, "energyscape", "raw", credit=64)
    for number in range(300):  # Each registration announces a new position.
        place = {"translation_m": (float(number), 0.0, 0.0)}
        loop.processing.register(hello("left", **place), SHORT)
        application.keep()  # The loop may outlast the timeout for silent applications.
        if number % 100 == 0:
            loop.processing.register(hello("front", **place), SHORT)
            publish(loop, 1)
    loop.processing.publish_status(Status(version="1", pid=1, host="here", address="x", state="processing"))
    publish(loop, 1)
    loop.until(lambda: application.read() or len(application.got) == 8)
    assert loop.processing.status().publisher_respawned == respawned
    places = [application.descriptions[image.description][0].translation_m[0] for image, _ in application.got]
    assert places == [0.0, 0.0, 100.0, 100.0, 200.0, 200.0, 200.0, 200.0]


def test_slowly_ending_publisher_blocks_nothing(loop, monkeypatch):
    publisher = loop.processing._publisher  # noqa: SLF001  the test delays the end of its process
    child = publisher._process.child  # noqa: SLF001
    monkeypatch.setattr(type(child), "ended", property(lambda _: False))
    monkeypatch.setattr(child, "close", lambda *_: pytest.fail("it is waited for"))
    os.kill(child.pid, signal.SIGKILL)
    loop.until(lambda: not publisher.serves)
    assert child.pipe.fileno() not in loop.processing.fds()
    monkeypatch.undo()
    loop.until(lambda: publisher.serves)


def test_hanging_publisher_is_killed(loop, monkeypatch):
    loop.processing.register(hello("hung"), SHORT)
    loop.until(lambda: loop.workers("idle"))
    respawned = loop.processing.status().publisher_respawned
    with monkeypatch.context() as patch:
        patch.setattr("ertis_numba.network.processing.publisher._HUNG_S", 1.5)
        process = loop.processing._publisher._process  # noqa: SLF001
        loop.until(lambda: process._deadline_s - time.monotonic() < 1.5)  # noqa: SLF001
        os.kill(loop.processing.status().publisher_pid, signal.SIGSTOP)
        for _ in range(5):
            loop.offer("hung")  # There are fewer slots.
        loop.until(lambda: loop.processing.status().publisher_respawned > respawned)
    loop.settle()
    publish(loop, 1, "hung")
    counts = loop.processing.counts("hung")
    assert counts.received == 6
    assert counts.dropped["the publisher died"] >= 1
    assert counts.published >= 1


def test_invalid_messages_are_refused_and_counted(loop, application):
    before = Counter(loop.processing.refused)
    application.socket.send(b"garbage")
    application.socket.send_multipart([encode(Ping()), b"more"])
    application.socket.send(encode(Ping())[:4] + b"\xff" + encode(Ping())[5:])
    application.send(Refused(code="hello", reason="no application sends this"))
    application.send(Ping())
    loop.until(lambda: application.read() or len(application.others) == 5)
    loop.until(lambda: sum(loop.processing.refused.values()) == before.total() + 4)
    assert Counter(loop.processing.refused) - before == {"message": 3, "version": 1}
    codes = [message.code for message in application.others if isinstance(message, Refused)]
    assert codes == ["message", "message", "version", "message"]
    assert isinstance(application.others[-1], Pong)


def test_unsubscribed_application_receives_nothing_more(loop, application):
    subscribed(loop, application, "energyscape", credit=8)
    loop.until(lambda: loop.processing.status().subscribers)
    application.send(Bye())
    loop.until(lambda: not loop.processing.status().subscribers)
    publish(loop, 1)
    assert application.got == []


class TestKeys:
    @pytest.fixture
    def pairs(self, tmp_path):
        pairs = {name: KeyPair.new(name) for name in ("central", "viewer", "front", "stranger")}
        listed = AllowList(
            keys=(
                Permission(name="viewer", public=pairs["viewer"].public, role="application"),
                Permission(name="front", public=pairs["front"].public, role="sensor", serials=("front",)),
            )
        )
        listed.save(tmp_path / "allow.toml")
        return pairs

    def connected(self, loop, pairs, name):
        return Application(loop.processing.address, ClientKeys(pairs[name], pairs["central"].public))

    def test_listed_application_is_served_until_its_key_is_removed(self, pairs, tmp_path):
        keys = ServerKeys(pairs["central"], tmp_path / "allow.toml")
        with driven(keys=keys) as loop, self.connected(loop, pairs, "viewer") as application:
            loop.processing.register(hello(), SHORT)
            subscribed(loop, application, "energyscape", "status", credit=8)
            publish(loop, 1)
            loop.until(lambda: application.read() or application.got)
            status = Status(version="1", pid=1, host="here", address="x", state="processing")
            loop.processing.publish_status(status)
            application.send(AskStatus())
            loop.until(lambda: application.read() or len(application.got) == 3)
            (reported,) = loop.processing.status().subscribers
            assert reported.name == "viewer"
            AllowList.load(tmp_path / "allow.toml").remove("viewer").save(tmp_path / "allow.toml")
            loop.until(lambda: not loop.processing.status().subscribers)
            publish(loop, 1)
            application.send(AskStatus())
            loop.until(lambda: loop.processing.refused.get("removed key", 0) >= 2)
            application.read()
        assert application.kinds() == ["Image", "Report", "Report"]

    def test_sensor_keys_and_unknown_keys_cannot_subscribe(self, pairs, tmp_path):
        keys = ServerKeys(pairs["central"], tmp_path / "allow.toml")
        with (
            driven(keys=keys) as loop,
            self.connected(loop, pairs, "front") as sensor,
            self.connected(loop, pairs, "stranger") as stranger,
        ):
            sensor.subscribe("energyscape")
            loop.until(lambda: sensor.read() or sensor.others)
            loop.until(lambda: {"role", "unknown key"} <= loop.processing.refused.keys())
            assert loop.processing.refused["role"] >= 1
            stranger.read()
        assert {refused.code for refused in sensor.others} == {"role"}
        assert stranger.others == stranger.got == []


class TestSubscribers:
    """Limits of connections, tested with routing ids and a socket that sends nothing."""

    class Frame:
        def __init__(self, content):
            self.bytes = content

    class Socket:
        def __init__(self):
            self.sent = []

        def send_multipart(self, parts, *_):
            self.sent.append(parts)

    def hear(self, subscribers, number, name):
        return subscribers.hear([self.Frame(bytes([0, number]))], name, Subscribe(products=("raw",)))

    def test_one_key_cannot_occupy_all_connections(self):
        subscribers = Subscribers(self.Socket(), with_keys=True)
        assert [self.hear(subscribers, number, "a") for number in range(20)] == [True] * 16 + [False] * 4
        assert self.hear(subscribers, 100, "b")
        assert self.hear(subscribers, 3, "a")  # This connection already exists.

    def test_silent_connections_of_a_key_are_closed_for_new_ones(self):
        subscribers = Subscribers(self.Socket(), with_keys=True)
        for number in range(16):
            self.hear(subscribers, number, "a")
        next(iter(subscribers)).retire()
        assert self.hear(subscribers, 50, "a")
        assert not self.hear(subscribers, 51, "a")

    def test_connections_without_keys_share_one_limit(self):
        subscribers = Subscribers(self.Socket())
        assert all(self.hear(subscribers, number, "loopback") for number in range(40))

    def test_product_is_copied_once_for_all_subscribers(self):
        socket, memory = self.Socket(), bytearray(b"first")
        subscribers = Subscribers(socket)
        wants = Subscribe(products=("status",), credit=1)
        applications = [[self.Frame(b"\0app%d" % number)] for number in range(3)]
        assert all(subscribers.hear(frames, "app", wants) for frames in applications)
        items = [QueuedProduct("status", "", Report(), [memoryview(memory)]) for _ in range(2)]
        for item in items:
            subscribers.offer(item)
        memory[:] = b"later"  # The slot is used again, while the second product waits for credit.
        payloads = [parts[-1] for parts in socket.sent]
        assert [payload.bytes for payload in payloads] == [b"first"] * 3
        assert all(payload is items[0].payloads[0] for payload in payloads)
        for frames in applications:
            assert subscribers.hear(frames, "app", Subscribe(products=("status",), consumed=1, credit=1))
        assert [parts[-1].bytes for parts in socket.sent] == [b"first"] * 6

    def test_product_without_subscribers_is_not_copied(self):
        subscribers = Subscribers(self.Socket())
        payload = memoryview(b"image")
        item = QueuedProduct("raw", "front", Report(), [payload])
        assert subscribers.hear([self.Frame(b"\0app")], "app", Subscribe(products=("status",)))
        subscribers.offer(item)
        assert item.payloads == [payload]

    def test_messages_of_all_subscribers_share_memory(self):
        data, wants = os.urandom(1_000_000), Subscribe(products=("raw",), credit=1)
        with zmq.Context() as context, context.socket(zmq.ROUTER) as router, ExitStack() as stack:
            router.bind("inproc://products")
            subscribers, dealers = Subscribers(router), []
            for _ in range(3):
                dealers.append(stack.enter_context(context.socket(zmq.DEALER)))
                dealers[-1].connect("inproc://products")
                dealers[-1].send(b"")
                assert subscribers.hear(router.recv_multipart(copy=False), "app", wants)
            subscribers.offer(QueuedProduct("raw", "front", Report(), [memoryview(data)]))
            payloads = [dealer.recv_multipart(copy=False)[-1] for dealer in dealers]
            assert all(payload.bytes == data for payload in payloads)
            # Within one process, ZeroMQ passes messages on without copying them.
            assert len({np.frombuffer(payload.buffer, np.uint8).ctypes.data for payload in payloads}) == 1


class TestSubscriber:
    def item(self, n_bytes=100):
        return QueuedProduct("raw", "front", None, [bytes(n_bytes)])

    def made(self, **values):
        wants = Subscribe(products=("raw",), **values)
        return ConnectedSubscriber((), "app", wants, before=wants.consumed)

    def test_credit_is_reduced_by_images_in_flight(self):
        one = self.made(credit=1)
        one.offer(self.item())
        key, number, _ = one.next()
        one.was_sent(key)
        one.offer(self.item())
        assert number == 0
        assert one.next() is None
        one.consumed(Subscribe(products=("raw",), consumed=1, credit=1))
        assert one.next()[1] == 1

    def test_bytes_in_flight_are_bounded_for_any_credit(self):
        one = self.made(credit=64)
        for _ in range(64):
            one.offer(self.item(14_000_000))
            if one.next() is not None:
                one.was_sent(("raw", "front"))
        assert sum(one.under_way) < 80_000_000
        assert (one.sent, one.dropped) == (5, 58)

    def test_impossible_count_gives_no_extra_credit(self):
        one = self.made(credit=1, consumed=50)
        one.offer(self.item())
        one.was_sent(("raw", "front"))
        one.consumed(Subscribe(products=("raw",), consumed=10**9, credit=1))
        assert len(one.under_way) == 0
        one.consumed(Subscribe(products=("raw",), consumed=0, credit=1))
        assert len(one.under_way) == 0

    def test_images_without_subscribers_are_counted(self):
        one = self.made()
        one.offer(self.item())
        one.consumed(Subscribe(products=("status",)))
        assert (one.next(), one.dropped) == (None, 1)
