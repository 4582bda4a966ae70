"""Server sockets: addresses, garbage on the port, and floods of connections."""

import contextlib
import random
import resource
import socket as raw

import pytest
import zmq

from ertis_numba.base.errors import ArgumentError, NetworkError
from ertis_numba.network import sockets
from ertis_numba.network.keys import ClientKeys, ServerKeys
from tests.zap_clients import CENTRAL, LISTED, LOOPBACK, MOMENT_S, PATIENCE_S, ROBOT, STRANGER, VIEWER, Door

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48)


@pytest.fixture
def door(tmp_path):
    with Door(tmp_path) as made:
        yield made


# Sockets


def test_public_address_requires_keys_on_both_sides():
    with zmq.Context() as context:
        for make in (sockets.server, sockets.client):
            with pytest.raises(ArgumentError, match="there are no keys"):
                make(context, "tcp://192.0.2.1:5601", keys=None)


def test_address_in_use_is_reported(door):
    with pytest.raises(NetworkError, match="is in use by"):
        sockets.server(door.context, door.address, keys=None)


def test_wildcard_server_reports_a_connectable_address(tmp_path):
    LISTED.save(tmp_path / "allow.toml")
    with (
        zmq.Context() as context,
        sockets.server(context, "tcp://*:0", keys=ServerKeys(CENTRAL, tmp_path / "allow.toml")) as server,
    ):
        assert sockets.bound(server).startswith("tcp://127.0.0.1:")


def test_immediate_refusal_is_reported(tmp_path):
    """The refusal may arrive after connecting but before the monitor starts."""
    with (
        Door(tmp_path) as door,
        zmq.Context() as context,
        sockets.client(context, door.address, keys=ClientKeys(STRANGER, CENTRAL.public)) as client,
    ):
        assert door.until(lambda: door.gate.refused["unknown key"])
        door.until(lambda: False, MOMENT_S)
        monitor = sockets.Monitor(client)
        assert [line[:40] for line in monitor.read()] == ["the central node does not know this key;"]
        monitor.close()


# Hostile connections


def test_server_accepts_more_connections_than_the_default_limit():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (1024, hard))
    try:
        with zmq.Context() as context, sockets.server(context, LOOPBACK, keys=None):
            assert resource.getrlimit(resource.RLIMIT_NOFILE) == (min(8192, hard % 2**63), hard)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_garbage_on_the_port_affects_no_client(door):
    random_ = random.Random(3)
    robot = door.knock(ROBOT)
    assert door.until(lambda: door.came)
    garbage = [b"", b"GET / HTTP/1.1\r\n\r\n", b"\xff" * 100, GREETING, GREETING + b"\x04\xff" * 50]
    garbage += [GREETING.replace(b"NULL", b"CURVE")[:64] + random_.randbytes(300) for _ in range(20)]
    garbage += [random_.randbytes(random_.randrange(1, 2000)) for _ in range(75)]
    for text in garbage:
        with raw.create_connection(("127.0.0.1", door.port)) as stranger:
            stranger.sendall(text)
        door.turn()
    door.say(robot, b"more")
    assert door.until(lambda: len(door.came) == 2)
    assert door.admits(VIEWER).name == "viewer"
    assert {who.name for _, who in door.came} == {"robot", "viewer"}


def test_overlong_frame_closes_only_its_connection(tmp_path):
    with Door(tmp_path, with_keys=False, max_bytes=1000) as door:
        good, bad = door.knock(None), door.knock(None, text=bytes(2000))
        assert door.until(lambda: door.came)
        door.say(bad, b"after")
        good.send(bytes(1000))
        assert door.until(lambda: any(len(text) == 1000 for text, _ in door.came))
        assert not any(len(text) > 1000 for text, _ in door.came)


@contextlib.contextmanager
def _slow_connections(door):
    """Yield connections that begin a handshake and never complete it."""
    handshakes = [raw.create_connection(("127.0.0.1", door.port)) for _ in range(200)]
    try:
        for number, stranger in enumerate(handshakes):
            stranger.sendall(GREETING.replace(b"NULL", b"CURVE")[: number % 64])
            stranger.settimeout(0)
        yield dict.fromkeys(handshakes)
    finally:
        for stranger in handshakes:
            stranger.close()


def test_slow_connections_block_nobody(tmp_path, monkeypatch):
    monkeypatch.setattr(sockets, "_HANDSHAKE_MS", round(1e3 * PATIENCE_S))
    with Door(tmp_path) as door, _slow_connections(door) as waiting:
        door.knock(ROBOT)
        assert door.until(lambda: door.came)
        assert len(_still_open(waiting)) == 200


def test_slow_connections_are_closed_and_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(sockets, "_HANDSHAKE_MS", 500)
    monkeypatch.setattr(sockets, "_LONGEST_HANDSHAKE_S", 1.5)
    with Door(tmp_path) as door, _slow_connections(door) as waiting:
        assert door.until(lambda: not _still_open(waiting))
        assert door.until(lambda: door.gate.refused["no key"] == 200)


def _still_open(connections):
    for connection in list(connections):
        try:
            while connection.recv(4096):
                pass
        except BlockingIOError:
            continue
        except OSError:
            pass
        del connections[connection]
    return connections
