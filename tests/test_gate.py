"""Who is let in, over real sockets with CURVE: those who are listed, as what they are, for as long as they are."""

import random
import resource
import socket as raw
import time

import pytest
import zmq

from ertis_numba.errors import ArgumentError, NetworkError, SettingsError
from ertis_numba.network import sockets
from ertis_numba.network.gate import EVERYBODY, Gate
from ertis_numba.network.keys import AllowList, ClientKeys, KeyPair, Permission, ServerKeys

CENTRAL, ROBOT, VIEWER, DESK, STRANGER = (
    KeyPair.new(name) for name in ("central", "robot", "viewer", "desk", "stranger")
)
LISTED = AllowList(
    keys=(
        Permission(name="robot", public=ROBOT.public, role="sensor", serials=("front", "left")),
        Permission(name="viewer", public=VIEWER.public, role="application"),
        Permission(name="desk", public=DESK.public, role="admin"),
    )
)
LOOPBACK = "tcp://127.0.0.1:*"
PATIENCE_S = 10.0  # of what is to happen
MOMENT_S = 0.4  # of what is not to happen: a handshake takes a hundredth of it
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48)


class Door:
    """A server and its gate in one loop, as a central node has them, and clients that knock."""

    def __init__(self, folder, *, with_keys=True, gate=Gate, server_gate=True, most_bytes=sockets.MOST_BYTES):
        self.list = folder / "allow.toml"
        LISTED.save(self.list)
        self.keys = ServerKeys(CENTRAL, self.list) if with_keys else None
        self.context, self.outside = zmq.Context(), zmq.Context()
        self.gate = gate(self.context, self.keys if server_gate else None)
        self.server = sockets.server(self.context, LOOPBACK, keys=self.keys, most_bytes=most_bytes)
        self.gate.watch(self.server)
        self.address = sockets.bound(self.server)
        self.port = int(self.address.rpartition(":")[2])
        self.changed = 0  # so often the list did
        self.came, self._clients, self._unsaid, self.monitors = [], [], [], {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.gate.close()
        for monitor in self.monitors.values():
            monitor.close()
        for client in self._clients:
            client.close(linger=0)
        self.server.close(linger=0)
        self.context.destroy(linger=0)  # also what a test that failed has left open
        self.outside.destroy(linger=0)

    def turn(self):
        """Once around the loop."""
        poller = zmq.Poller()
        for each in (self.server, self.gate.socket):
            if each is not None:
                poller.register(each, zmq.POLLIN)
        for client, text in self._unsaid[:]:
            if client.poll(0, zmq.POLLOUT):
                client.send(text, zmq.NOBLOCK)
                self._unsaid.remove((client, text))
        poller.poll(5)
        self.gate.serve()
        while self.server.poll(0):
            frames = self.server.recv_multipart(copy=False)
            self.came.append((frames[-1].bytes, self.gate.who(frames)))
        self.changed += self.gate.tick()

    def until(self, condition, patience_s=PATIENCE_S):
        """Serve until something is so; whether it became so."""
        end_s = time.monotonic() + patience_s
        while not (so := condition()) and time.monotonic() < end_s:
            self.turn()
        return bool(so)

    def knock(self, pair, *, server=CENTRAL.public, options=(), text=b"hello"):
        """Connect, and send when connected."""
        keys = ClientKeys(pair, server) if pair else None
        client = sockets.client(self.outside, self.address, keys=keys)
        for option, value in options:
            client.setsockopt(option, value)
        if options:  # they count for the next connection
            client.disconnect(self.address)
            client.connect(self.address)
        self.monitors[client] = sockets.Monitor(client)
        self._clients.append(client)
        self.say(client, text)
        return client

    def say(self, client, text):
        """Send something as soon as a client is connected."""
        self._unsaid.append((client, text))

    def told(self, client):
        """Wait until a client is told why it is not let in."""
        lines = []
        assert self.until(lambda: lines.extend(self.monitors[client].read()) or lines)
        return lines[0]

    def admits(self, pair, **options):
        """Whether a key is let in within a moment, and as what."""
        text = random.randbytes(8)
        self.knock(pair, text=text, **options)
        self.until(lambda: any(came == text for came, _ in self.came), MOMENT_S)
        return next((who for came, who in self.came if came == text), None)


@pytest.fixture
def door(tmp_path):
    with Door(tmp_path) as made:
        yield made


def _replace(door, listed):
    listed.save(door.list)


@pytest.mark.parametrize(
    ("pair", "sends", "receives"),
    [(ROBOT, {"front", "left"}, False), (VIEWER, set(), True), (DESK, {"front", "left", "rear"}, True)],
    ids=["sensor", "application", "admin"],
)
def test_a_listed_key_is_let_in_as_what_it_is_listed(door, pair, sends, receives):
    door.knock(pair)
    assert door.until(lambda: door.came)
    ((_, who),) = door.came
    assert who == LISTED.find(pair.public)
    assert {sensor for sensor in ("front", "left", "rear") if who.may_send(sensor)} == sends
    assert who.may_receive is receives
    assert not +door.gate.refused


def test_an_unknown_key_is_refused_counted_and_told(door):
    client = door.knock(STRANGER)
    assert door.told(client).startswith("the central node does not know this key; have it listed")
    assert door.monitors[client].final
    assert door.admits(STRANGER) is None
    assert (door.came, +door.gate.refused) == ([], {"unknown key": 2})


def test_a_node_that_expects_another_central_node_says_nothing_to_this_one(door):
    client = door.knock(ROBOT, server=STRANGER.public)
    assert "another key than --server-key says" in door.told(client)
    assert door.until(lambda: door.gate.refused["wrong server key"])
    assert not door.came


def test_a_node_without_a_key_is_refused_and_counted(door):
    client = door.knock(None)
    assert door.told(client).endswith("give --key and --server-key")
    assert door.until(lambda: door.gate.refused["no key"])
    assert not door.came


def test_a_password_is_no_key(door):
    assert door.admits(None, options=[(zmq.PLAIN_USERNAME, b"admin"), (zmq.PLAIN_PASSWORD, b"admin")]) is None
    assert door.until(lambda: door.gate.refused["no key"])


def test_a_node_with_keys_says_nothing_to_one_without(tmp_path):
    with Door(tmp_path, with_keys=False) as door:
        client = door.knock(ROBOT)
        assert "key" in door.told(client)
        assert not door.came


def test_without_keys_everybody_may_do_everything(tmp_path):
    with Door(tmp_path, with_keys=False) as door:
        assert door.admits(None) is EVERYBODY
        assert EVERYBODY.may_send("any")
        assert EVERYBODY.may_receive
        assert door.gate.socket is None


def test_a_routing_id_that_a_peer_has_chosen_is_refused(door):
    door.knock(ROBOT, options=[(zmq.ROUTING_ID, b"front")])
    assert door.until(lambda: door.came)
    assert door.came == [(b"hello", None)]
    assert door.gate.refused["chosen routing id"] == 1


def test_a_message_that_came_past_the_gate_is_nobodys(door):
    past = sockets.server(door.context, LOOPBACK, keys=None)
    client = sockets.client(door.outside, sockets.bound(past), keys=None)
    door.monitors[client] = sockets.Monitor(client)
    assert client.poll(1e3 * PATIENCE_S, zmq.POLLOUT)
    client.send(b"hello")
    assert past.poll(1e3 * PATIENCE_S)
    assert door.gate.who(past.recv_multipart(copy=False)) is None
    assert door.gate.refused["no key"] == 1
    assert door.gate.who([]) is None
    past.close()


# The list changes


def test_a_removed_key_is_refused_within_a_second_although_connected(door):
    client = door.knock(ROBOT)
    assert door.until(lambda: door.came)
    _replace(door, LISTED.remove("robot"))
    removed_s = time.monotonic()
    while not door.came or door.came[-1][1] is not None:
        door.say(client, b"more")
        door.turn()
        assert time.monotonic() - removed_s < 1.0
    assert door.until(lambda: door.changed == 1)
    assert door.gate.refused["removed key"] >= 1
    before = len(door.came)
    door.say(client, b"still")
    assert door.until(lambda: len(door.came) > before)
    assert door.came[-1][1] is None
    assert door.admits(ROBOT) is None
    assert door.gate.refused["unknown key"] == 1


def test_a_key_that_is_listed_while_connections_wait_is_let_in(door):
    assert door.admits(STRANGER) is None
    _replace(door, LISTED.allow(Permission(name="stranger", public=STRANGER.public, role="application")))
    assert door.until(lambda: door.changed == 1)
    assert door.admits(STRANGER).name == "stranger"


def test_a_connection_has_the_role_and_serials_of_the_list_as_it_is_now(door):
    client = door.knock(ROBOT)
    assert door.until(lambda: door.came)
    _replace(door, LISTED.allow(Permission(name="robot", public=ROBOT.public, role="sensor", serials=("rear",))))
    assert door.until(lambda: door.changed == 1)
    door.say(client, b"more")
    assert door.until(lambda: len(door.came) == 2)
    assert [who.serials for _, who in door.came] == [("front", "left"), ("rear",)]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_text("keys = 7"),
        lambda path: path.write_text(path.read_text()[:-10]),
        lambda path: path.write_bytes(b"\xff\xfe\x00"),
        lambda path: path.write_bytes(b"#" * 4_000_001),
        lambda path: path.unlink(),
        lambda path: (path.unlink(), path.mkdir()),
    ],
    ids=["other", "cut", "bytes", "huge", "gone", "folder"],
)
def test_nobody_is_in_a_list_that_cannot_be_read(door, spoil):
    client = door.knock(DESK)
    assert door.until(lambda: door.came)
    spoil(door.list)
    assert door.until(lambda: door.changed == 1)
    assert door.gate.note
    assert len(door.gate.note.splitlines()) == 1
    door.say(client, b"more")
    assert door.until(lambda: len(door.came) == 2)
    assert door.came[-1][1] is None
    assert door.admits(ROBOT) is None
    if door.list.is_dir():
        door.list.rmdir()
    _replace(door, LISTED)
    assert door.until(lambda: door.changed == 2)
    assert not door.gate.note
    assert door.admits(ROBOT).name == "robot"


def test_a_list_that_somebody_is_writing_is_looked_at_twice(door):
    client = door.knock(DESK)
    assert door.until(lambda: door.came)
    door.list.write_text("keys = [")
    looked_s = door.gate._next_look_s  # noqa: SLF001  so that this is no matter of time
    assert door.until(lambda: door.gate._next_look_s > looked_s)  # noqa: SLF001
    _replace(door, LISTED.remove("viewer"))
    assert door.until(lambda: door.changed == 1)
    door.say(client, b"more")
    assert door.until(lambda: len(door.came) == 2)
    assert (door.came[-1][1].name, door.gate.note) == ("desk", "")
    assert not +door.gate.refused


@pytest.mark.parametrize(
    "text",
    [None, "keys = 7", f'[[keys]]\nname = "robot"\npublic = "{ROBOT.public}"\nrole = "sensor"\n'],
    ids=["missing", "no_list", "no_serials"],
)
def test_a_list_that_cannot_be_used_at_the_start_is_told(tmp_path, text):
    path = tmp_path / "allow.toml"
    if text is not None:
        path.write_text(text)
    with zmq.Context() as context, pytest.raises(SettingsError, match=r"allow\.toml"):
        Gate(context, ServerKeys(CENTRAL, path))


# The gate fails


class _Raises(Gate):
    def _decide(self, request):
        raise KeyError(request)


class _LetsIn(Gate):
    def _decide(self, request):  # noqa: ARG002
        return self._mark + STRANGER.public, ""


def test_a_gate_that_fails_lets_nobody_in_and_goes_on(tmp_path):
    with Door(tmp_path, gate=_Raises) as door:
        assert "does not know this key" in door.told(door.knock(ROBOT))
        assert "does not know this key" in door.told(door.knock(ROBOT))
        assert (door.came, +door.gate.refused) == ([], {"gate: KeyError": 2})


def test_a_server_without_a_gate_lets_nobody_in(tmp_path):
    """By itself, CURVE would let any key in: ZAP_ENFORCE_DOMAIN makes it ask, and nobody answers."""
    with Door(tmp_path, server_gate=False) as door:
        assert [door.admits(pair) for pair in (DESK, ROBOT, STRANGER)] == [None, None, None]
        assert not door.came


def test_a_gate_that_is_not_served_or_closed_lets_nobody_in(door):
    serve, door.gate.serve = door.gate.serve, lambda: None
    assert door.admits(DESK) is None
    door.gate.serve = serve
    assert door.admits(VIEWER).name == "viewer"
    door.gate.close()
    before = len(door.came)
    assert door.admits(ROBOT) is None
    assert len(door.came) <= before + 1  # the one that had waited


def test_whatever_a_gate_is_asked_the_answer_is_no_or_none(door):
    """Seed 5: requests that are no requests, from within the context."""
    random_ = random.Random(5)
    asker = door.context.socket(zmq.DEALER)
    asker.connect("inproc://zeromq.zap.01")
    good = [b"", b"1.0", b"1", b"ertis", b"127.0.0.1", b"", b"CURVE", bytes(32)]
    for _ in range(1000):
        request = list(good)
        for _ in range(random_.randrange(1, 4)):
            place = random_.randrange(len(request))
            match random_.randrange(3):
                case 0:
                    request[place] = random_.randbytes(random_.choice([0, 1, 31, 32, 33, 300]))
                case 1:
                    request.insert(place, random_.randbytes(4))
                case _ if len(request) > 1:
                    del request[place]
        asker.send_multipart(request)
        door.gate.serve()
        while asker.poll(0):
            assert asker.recv_multipart()[3] == b"400"
    asker.close()
    assert door.admits(ROBOT).name == "robot"


def test_a_self_test_passes_and_counts_nothing(door):
    began_s = time.monotonic()
    door.gate.self_test(door.address)
    assert time.monotonic() - began_s < 2.0
    for _ in range(5):
        door.turn()
    assert not door.gate.refused
    assert door.admits(ROBOT).name == "robot"


def test_a_self_test_fails_where_an_unknown_key_is_let_in(tmp_path):
    with Door(tmp_path, gate=_LetsIn) as door, pytest.raises(NetworkError, match="lets in a node with unknown key; do"):
        door.gate.self_test(door.address)


def test_a_self_test_fails_where_a_node_without_a_key_is_let_in(door):
    past = sockets.server(door.context, LOOPBACK, keys=None)
    with pytest.raises(NetworkError, match="lets in a node with no key; do"):
        door.gate.self_test(sockets.bound(past))
    past.close()


def test_a_self_test_fails_where_nothing_answers(door, monkeypatch):
    monkeypatch.setattr("ertis_numba.network.gate._SELF_TEST_S", 0.2)
    with pytest.raises(NetworkError, match=r"did not refuse a node with no key within 0\.2 s; start it when"):
        door.gate.self_test("tcp://127.0.0.1:1")


def test_a_context_has_one_gate(door):
    with pytest.raises(ArgumentError, match="has a gate already; make one for each"):
        Gate(door.context, door.keys)


# Sockets


def test_an_address_that_others_can_reach_needs_keys_on_both_sides():
    with zmq.Context() as context:
        for make in (sockets.server, sockets.client):
            with pytest.raises(ArgumentError, match="there are no keys"):
                make(context, "tcp://192.0.2.1:5601", keys=None)


def test_an_address_that_is_in_use_is_told(door):
    with pytest.raises(NetworkError, match="cannot be listened at"):
        sockets.server(door.context, door.address, keys=None)


def test_a_server_on_all_addresses_is_told_as_one_that_can_be_connected_to(tmp_path):
    LISTED.save(tmp_path / "allow.toml")
    with (
        zmq.Context() as context,
        sockets.server(context, "tcp://*:0", keys=ServerKeys(CENTRAL, tmp_path / "allow.toml")) as server,
    ):
        assert sockets.bound(server).startswith("tcp://127.0.0.1:")


def test_a_refusal_that_comes_at_once_is_told(tmp_path):
    """Between connecting and watching, everything may have happened already."""
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


def test_a_server_has_room_for_more_connections_than_a_process_has_by_default():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (1024, hard))
    try:
        with zmq.Context() as context, sockets.server(context, LOOPBACK, keys=None):
            assert resource.getrlimit(resource.RLIMIT_NOFILE) == (min(8192, hard % 2**63), hard)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_garbage_on_the_port_harms_nobody(door):
    """Seed 3."""
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


def test_a_frame_that_is_too_long_ends_its_connection_alone(tmp_path):
    with Door(tmp_path, with_keys=False, most_bytes=1000) as door:
        good, bad = door.knock(None), door.knock(None, text=bytes(2000))
        assert door.until(lambda: door.came)
        door.say(bad, b"after")
        good.send(bytes(1000))
        assert door.until(lambda: any(len(text) == 1000 for text, _ in door.came))
        assert not any(len(text) > 1000 for text, _ in door.came)


def test_two_hundred_slow_connections_keep_nobody_out_and_are_hung_up_on(door):
    strangers = [raw.create_connection(("127.0.0.1", door.port)) for _ in range(200)]
    try:
        for number, stranger in enumerate(strangers):
            stranger.sendall(GREETING.replace(b"NULL", b"CURVE")[: number % 64])
        began_s = time.monotonic()
        door.knock(ROBOT)
        assert door.until(lambda: door.came)
        assert time.monotonic() - began_s < 2.0
        waiting = dict.fromkeys(strangers)
        for stranger in strangers:
            stranger.settimeout(0)
        assert door.until(lambda: not _still_open(waiting), 6.0)
        assert door.until(lambda: door.gate.refused["no key"] >= 190)
    finally:
        for stranger in strangers:
            stranger.close()


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
