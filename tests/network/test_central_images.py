"""A central node with image processing: the node keeps working when processing fails."""

import os
import threading
from collections import Counter
from types import SimpleNamespace
from typing import ClassVar

import pytest

from ertis_numba.network import messages
from ertis_numba.network.central_node import Archive, CentralNode
from ertis_numba.network.messages import Ack, Ping, Pong
from ertis_numba.network.status import Percentiles, ProcessingStatus
from tests.central import Node, running, stored, wanted
from tests.journals import EPOCH, entries
from tests.sending import SOON_S, until


class Images:
    """A stand-in for image processing."""

    refused: ClassVar = {}

    def __init__(self):
        self.known, self.offered = [], []

    def register(self, hello, settings):
        self.known.append((hello.sensor, settings))

    def offer(self, data, words, arrived_ns):
        self.offered.append((data.sequence, words.copy(), arrived_ns))

    def counts(self, _):
        return SimpleNamespace(
            published=2, passive=1, dropped=Counter(late=1), in_flight=1, queue=1, latency=Percentiles()
        )

    def status(self):
        return ProcessingStatus()

    def fds(self):
        return ()

    def start(self, _):
        pass

    def tick(self, _):
        pass

    publish_status = close = ready = tick

    def drain_dropped(self):
        return []


@pytest.mark.parametrize("archive", [True, False])
def test_processing_gets_each_measurement_once(archive, tmp_path):
    images, given = Images(), entries(3)
    with running(tmp_path if archive else None, processing=images) as central, Node(central.address) as node:
        welcome = node.hello()
        assert (welcome.state, welcome.acks) == ("processing", "stored" if archive else "accepted")
        assert welcome.acked_through == (-1 if archive else 9)
        node.measure(*given, given[0])
        assert node.hear_settled(12).status == welcome.acks
        node.send(Ping())
        node.hear(Pong)
    assert [each[0] for each in images.offered] == [10, 11, 12]
    assert all(
        (words == entry.measurement.data).all() for (_, words, _), entry in zip(images.offered, given, strict=True)
    )
    assert images.known[0][0] == "left"
    sensor = central.latest.sensors["left"]
    assert (sensor.received, sensor.repeated, sensor.published, sensor.dropped) == (3, 1, 2, {"late": 1})


def test_session_survives_reconnect_without_archive():
    with running(processing=Images()) as central:
        with Node(central.address) as node:
            node.hello()
            node.measure(*entries(3))
            node.hear_settled(12)
            node.send(messages.Bye())
        with Node(central.address) as node:
            assert node.hello(first=11).acked_through == 12
            node.measure(entries(2)[1])
            node.send(Ping())
            assert node.hear(Ack).acked_through == 12
    assert central.latest.sensors["left"].received == 3


FAILING = ("register", "offer", "fds", "ready", "tick", "counts", "status", "publish_status", "drain_dropped", "close")


@pytest.mark.parametrize("what", [*FAILING, "all"])
def test_ingest_continues_when_processing_fails(what, tmp_path, monkeypatch):
    def fails(*_):
        raise MemoryError("no more")

    given, reads = entries(2), os.pipe()
    for name in FAILING if what == "all" else [what]:
        monkeypatch.setattr(Images, name, fails)
    if what == "ready":
        monkeypatch.setattr(Images, "fds", lambda _: reads[:1])
        os.write(reads[1], b".")
    monkeypatch.setattr("ertis_numba.network.central_node._node._STATUS_S", 0.0)
    monkeypatch.setattr("ertis_numba.network.central_node._reporting._LOG_INTERVAL_S", 1000.0)
    with running(tmp_path, processing=Images()) as central, Node(central.address) as node:
        node.hello()
        node.measure(*given)
        node.hear_settled(11)
        if what != "close":
            until(lambda: any(event["event"] == "internal" for event in central.events))
    for end in reads:
        os.close(end)
    assert stored(tmp_path)[0] == wanted(given)
    assert central.latest.refused["internal"] >= 1
    reported = [event["text"] for event in central.events if event["event"] == "internal"]
    assert reported == ["MemoryError: no more"]  # at most one report per interval
    with running(tmp_path):  # the folder is no longer in use
        pass


def test_drops_of_processing_are_reported_to_the_sensor_node(monkeypatch):
    drops = [[("left", EPOCH, 10, "superseded")]]
    monkeypatch.setattr(Images, "drain_dropped", lambda _: drops.pop() if drops else [])
    with running(processing=Images()) as central, Node(central.address) as node:
        drops.clear()
        node.hello()
        drops.append([("left", EPOCH, 10, "superseded")])
        reported = ()
        while not reported:
            node.send(Ping())
            reported = node.hear(Ack).dropped
    assert reported == ((10, "superseded"),)


class Loading(Images):
    """Image processing whose worker processes never become ready."""

    def __init__(self):
        self.waits, self.closed = threading.Event(), False

    def start(self, stopping):
        self.waits.set()
        until(stopping)

    def close(self, _):
        self.closed = True


def test_stop_ends_the_wait_for_loading_workers(tmp_path):
    images, events = Loading(), []
    central = CentralNode("tcp://127.0.0.1:0", archive=Archive(tmp_path), processing=images, on_event=events.append)

    def stop():
        assert images.waits.wait(SOON_S)
        central.stop()

    thread = threading.Thread(target=stop)
    thread.start()
    with central:
        central.run()
    thread.join()
    assert images.closed
    assert "listening" not in [event["event"] for event in events]
