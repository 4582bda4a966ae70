"""A publisher for tests: the protocol of applications without image processing."""

import contextlib
import functools
import json
import threading
import time
import types
import zlib
from dataclasses import dataclass, field

import msgspec
import numpy as np
import pytest
import zmq

from ertis_numba.analysis.point_spread import PointSpread
from ertis_numba.frames import Energyscape, Measurement, PointCloud, Stamp
from ertis_numba.geometry import direction_grid, unit_vectors
from ertis_numba.network import messages, sockets
from ertis_numba.network.status import Status
from ertis_numba.network.zap_authenticator import ZapAuthenticator
from ertis_numba.settings import Processing, Settings

SETTINGS = Settings(processing=Processing(directions="2d:31", range_m=(0.5, 3.0)))
RANGE_M = np.arange(0.5, 3.0, 0.004)
ALL = ("energyscape", "points", "raw", "group", "status")
PATIENCE_S = 60.0
PART = 5_000  # bytes per frame: images take several frames


@pytest.fixture
def patient_applications(monkeypatch):
    """Let applications wait for a publisher on a busy machine: it would lose what it sent on a former connection."""
    monkeypatch.setattr("ertis_numba.network._subscription.SILENCE_LIMIT_S", PATIENCE_S)
    monkeypatch.setattr("ertis_cli._product_printer._SOON_S", PATIENCE_S)


@functools.cache
def spread():
    return PointSpread(SETTINGS)


PATIENT_APPLICATIONS = pytest.mark.usefixtures("patient_applications")


def image(sequence=0, *, sensor="front", reflectors=(), sync_count=None, **stamp):
    """An image with reflectors, each given by azimuth in degrees, range in m and amplitude.

    Echoes have the lobes of the array and the pulses of the call, because points are fits of these.
    """
    grid = direction_grid(SETTINGS.processing)
    amplitude = np.full((len(grid), len(RANGE_M)), 1e-4, np.float32)
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    for azimuth_deg, range_m, peak in reflectors:
        near = np.flatnonzero(np.abs(RANGE_M - range_m) < spread().reach_m)
        offset = directions - unit_vectors(np.radians([azimuth_deg]), np.zeros(1))
        found = spread()(np.repeat(offset, len(near), axis=0), np.tile(RANGE_M[near] - range_m, len(grid)))
        amplitude[:, near] += (peak * found.reshape(len(grid), -1)).astype(np.float32)
    stamp = Stamp(
        sensor=sensor,
        sequence=sequence,
        session_id=7,
        sync_count=sequence if sync_count is None else sync_count,
        **{"timestamp_ns": 1_700_000_000_000_000_000 + sequence * 100_000_000, "timestamp_uncertainty_ns": 900} | stamp,
    )
    return Energyscape(amplitude, grid.azimuth_rad, grid.elevation_rad, RANGE_M, SETTINGS, stamp)


def cloud(sequence=0, *, position_m=((1.0, 0.0, 0.0),), sensor="front"):
    position_m = np.array(position_m, np.float32).reshape(-1, 3)
    amplitude = np.linspace(1, 0.5, len(position_m), dtype=np.float32)
    return PointCloud(position_m, amplitude, SETTINGS, image(sequence, sensor=sensor).stamp)


def measurement(sequence=0, *, sensor="front", temperature_c=20.0):
    settings = SETTINGS.replace(air=SETTINGS.air.replace(temperature_c=temperature_c))
    words = np.random.default_rng(sequence).integers(0, 2**32, settings.recording.n_samples, dtype=np.uint32)
    return Measurement(words, settings, image(sequence, sensor=sensor).stamp)


def group(number, *sensors, missing=()):
    members = tuple((sensor, 7, number) for sensor in sensors)
    return messages.Group(number=0, dropped=0, group=number, members=members, missing=missing, spread_ns=1200)


def status(**fields):
    return Status(version="1", pid=1, host="here", address="tcp://127.0.0.1:1", state="processing", **fields)


@dataclass
class Peer:
    """State of a subscriber in the publisher."""

    wanted: messages.Subscribe
    before: int = 0
    number: int = 0
    sent: int = 0
    dropped: int = 0
    described: dict = field(default_factory=dict)

    @property
    def has_room(self):
        return self.sent - (self.wanted.consumed - self.before) < self.wanted.credit


class Publisher:
    """A publisher that serves while `pump` runs, or in its own thread within `playing`."""

    translation_m = (1.0, 2.0, 3.0)
    rotation_xyzw = (0.0, 0.0, 1.0, 0.0)

    def __init__(self, *, address="tcp://127.0.0.1:0", keys=None, answers=True, describes_each=False):
        self._context = zmq.Context(io_threads=1)
        self._authenticator = ZapAuthenticator(self._context, keys)
        self._socket = sockets.server(self._context, address, keys=keys)
        self.address = sockets.bound(self._socket)
        self.answers = answers
        self._describes_each = describes_each
        self.peers: dict[bytes, Peer] = {}
        self.heard: list[messages.Message] = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._authenticator.close()
        self._context.destroy(linger=0)

    def pump(self, until, *, within_s=PATIENCE_S):
        """Serve until a condition holds; fail after ``within_s``."""
        end_s = time.monotonic() + within_s
        while not until():
            assert time.monotonic() < end_s, "it did not come to that"
            self._turn()

    def _turn(self):
        poller = zmq.Poller()
        for socket in (self._socket, self._authenticator.socket):
            if socket is not None:
                poller.register(socket, zmq.POLLIN)
        ready = [socket for socket, _ in poller.poll(5)]
        if self._authenticator.socket in ready:
            self._authenticator.serve()
        if self._socket in ready:
            peer, *frames = self._socket.recv_multipart()
            message = messages.decode(frames[0], (messages.Subscribe, messages.Ping, messages.Bye))
            self.heard.append(message)
            if isinstance(message, messages.Subscribe):
                self.peers.setdefault(peer, Peer(message, message.consumed)).wanted = message
            elif isinstance(message, messages.Bye):
                self.peers.pop(peer, None)
            elif self.answers:
                self.notify(peer, messages.Pong(state="processing"))

    def notify(self, peer, message, *payload):
        with contextlib.suppress(zmq.ZMQError):  # the peer has left
            self._socket.send_multipart([peer, messages.encode(message), *payload])

    def tell_all(self, message, *payload):
        for peer in self.peers:
            self.notify(peer, message, *payload)

    def raw(self, *frames):
        for peer in self.peers:
            self._socket.send_multipart([peer, *frames])

    def publish(self, item, **changes):
        """Send an item to subscribers with credit, or count it as dropped; ``changes`` alter its header."""
        for key, peer in self.peers.items():
            sensor = item.stamp.sensor if hasattr(item, "stamp") else None
            if kind_of(item) not in peer.wanted.products or (
                sensor is not None and peer.wanted.sensors is not None and sensor not in peer.wanted.sensors
            ):
                continue
            number, peer.number = peer.number, peer.number + 1
            if not peer.has_room:
                peer.dropped += 1
                continue
            peer.sent += 1
            header, payload = self._message(item, key, peer, number=number, dropped=peer.dropped)
            self.notify(key, msgspec.structs.replace(header, **changes), *payload)

    def _message(self, item, key, peer, **common):
        if isinstance(item, messages.Group):
            return msgspec.structs.replace(item, **common), ()
        if isinstance(item, Status):
            return messages.Report(**common), (msgspec.msgpack.encode(item),)
        stamp = item.stamp
        common |= {
            "description": self._describe(item, key, peer),
            "sensor": stamp.sensor,
            "session_id": stamp.session_id,
            "sequence": stamp.sequence,
            "sync_count": stamp.sync_count,
            "timestamp_ns": stamp.timestamp_ns,
            "uncertainty_ns": stamp.timestamp_uncertainty_ns,
            "monotonic_ns": 5,
            "behaviour": stamp.behaviour,
        }
        if isinstance(item, Measurement):
            air, words = item.settings.air, item.data.tobytes()
            common |= {name: getattr(air, name) for name in ("temperature_c", "humidity_percent", "pressure_pa")}
            return messages.Raw(crc32=zlib.crc32(words), **common), (words,)
        common |= {"received_ns": 1_000_000, "published_ns": 13_000_000}
        if isinstance(item, PointCloud):
            rows = np.concatenate([item.position_m, item.amplitude[:, None]], axis=1)
            return messages.Points(n_points=len(item), **common), (rows.tobytes(),)
        body = item.amplitude.tobytes()
        parts = [body[start : start + PART] for start in range(0, len(body), PART)]
        return messages.Image(shape=item.amplitude.shape, dtype=item.amplitude.dtype.name, **common), parts

    def _describe(self, item, key, peer):
        about = (item.stamp.sensor, kind_of(item), item.stamp.sequence if self._describes_each else 0)
        if about not in peer.described:
            peer.described[about] = len(peer.described)
            described = messages.Description(
                number=peer.described[about],
                sensor=item.stamp.sensor,
                translation_m=self.translation_m,
                rotation_xyzw=self.rotation_xyzw,
            )
            axes = [b"", b"", b""]
            if isinstance(item, Energyscape):
                axes = [item.azimuth_rad.tobytes(), item.elevation_rad.tobytes(), item.range_m.tobytes()]
            self.notify(key, described, item.settings.replace(air=SETTINGS.air).to_toml().encode(), *axes)
        return peer.described[about]

    @contextlib.contextmanager
    def playing(self, items):
        """Publish items from the first subscription on, each once all subscribers have credit, until the block ends."""
        ended = threading.Event()
        failed = []

        def play():
            try:
                self.pump(lambda: self.peers or ended.is_set())
                for item in items:
                    self.pump(lambda: ended.is_set() or all(peer.has_room for peer in self.peers.values()))
                    self.publish(item)
                self.pump(ended.is_set, within_s=3 * PATIENCE_S)
            except Exception as error:  # noqa: BLE001  reported in the test's thread
                failed.append(error)

        thread = threading.Thread(target=play)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
        assert not failed, failed


def kind_of(item):
    kinds = {Energyscape: "energyscape", PointCloud: "points", Measurement: "raw", Status: "status"}
    return kinds.get(type(item), "group")


def results_of(monkeypatch, owner, name):
    """Return a list to which each call of a method adds its result."""
    results, method = [], getattr(owner, name)

    def call(*arguments, **options):
        results.append(method(*arguments, **options))
        return results[-1]

    monkeypatch.setattr(owner, name, call)
    return results


def events_of(lines):
    """Return the events in lines of JSON, without those of a connection that a busy machine makes slowly."""
    return (event for event in map(json.loads, lines) if event["event"] not in {"waiting", "note"})


def end_when(monkeypatch, module, is_over):
    """End the duration of the command in a module once a condition holds, even on a slow machine."""
    clock = types.SimpleNamespace(monotonic=lambda: 1e6 if is_over() else 0.0)
    monkeypatch.setattr(f"{module}.time", clock)


def subscribed(publisher, count=1):
    publisher.pump(lambda: len(publisher.peers) == count)


def got(publisher, subscriber):
    """Serve until the subscriber receives an item; return it."""
    items = []

    def came():
        item = subscriber.receive(0)
        items.extend([] if item is None else [item])
        return bool(items)

    publisher.pump(came)
    return items[0]


def consumed(publisher, count):
    publisher.pump(lambda: all(peer.wanted.consumed == count for peer in publisher.peers.values()))
