"""Authentication over real sockets with CURVE: listed keys are admitted with their role, and no others."""

import random
import time

import pytest
import zmq

from ertis_numba.base.errors import ArgumentError, NetworkError
from ertis_numba.network import sockets
from ertis_numba.network.zap_authenticator import EVERYBODY, ZapAuthenticator
from tests.zap_clients import DESK, LISTED, LOOPBACK, PATIENCE_S, ROBOT, STRANGER, VIEWER, Door


@pytest.fixture
def door(tmp_path):
    with Door(tmp_path) as made:
        yield made


@pytest.mark.parametrize(
    ("pair", "sends", "receives"),
    [(ROBOT, {"front", "left"}, False), (VIEWER, set(), True), (DESK, {"front", "left", "rear"}, True)],
    ids=["sensor", "application", "admin"],
)
def test_listed_key_is_admitted_with_its_role(door, pair, sends, receives):
    door.knock(pair)
    assert door.until(lambda: door.came)
    ((_, who),) = door.came
    assert who == LISTED.find(pair.public)
    assert {sensor for sensor in ("front", "left", "rear") if who.may_send(sensor)} == sends
    assert who.may_receive is receives
    assert not +door.gate.refused


def test_unknown_key_is_refused_counted_and_reported(door):
    client = door.knock(STRANGER)
    assert door.reported(client).startswith(
        "the central node does not know this key; add it there with 'ertis keys allow'"
    )
    assert door.monitors[client].final
    assert door.admits(STRANGER) is None
    assert (door.came, +door.gate.refused) == ([], {"unknown key": 2})


def test_node_expecting_another_server_key_sends_nothing(door):
    client = door.knock(ROBOT, server=STRANGER.public)
    assert "its key is not the expected one, or it has none" in door.reported(client)
    assert door.until(lambda: door.gate.refused["no key"])
    assert not door.came


def test_node_without_a_key_is_refused_and_counted(door):
    client = door.knock(None)
    assert door.reported(client).endswith("set one (keys)")
    assert door.until(lambda: door.gate.refused["no key"])
    assert not door.came


def test_password_is_not_accepted_as_a_key(door):
    assert door.admits(None, options=[(zmq.PLAIN_USERNAME, b"admin"), (zmq.PLAIN_PASSWORD, b"admin")]) is None
    assert door.until(lambda: door.gate.refused["no key"])


def test_node_with_keys_sends_nothing_to_one_without(tmp_path):
    with Door(tmp_path, with_keys=False) as door:
        client = door.knock(ROBOT)
        assert "key" in door.reported(client)
        assert not door.came


def test_without_keys_every_role_is_permitted(tmp_path):
    with Door(tmp_path, with_keys=False) as door:
        assert door.admits(None) is EVERYBODY
        assert EVERYBODY.may_send("any")
        assert EVERYBODY.may_receive
        assert door.gate.socket is None


def test_chosen_routing_id_is_refused(door):
    door.knock(ROBOT, options=[(zmq.ROUTING_ID, b"front")])
    assert door.until(lambda: door.came)
    assert door.came == [(b"hello", None)]
    assert door.gate.refused["chosen routing id"] == 1


def test_unauthenticated_message_has_no_role(door):
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


# The gate fails


class _Raises(ZapAuthenticator):
    def _decide(self, request):
        raise KeyError(request)


class _LetsIn(ZapAuthenticator):
    def _decide(self, request):  # noqa: ARG002
        return self._mark + STRANGER.public, ""


def test_failing_authenticator_admits_nobody_and_continues(tmp_path):
    with Door(tmp_path, gate=_Raises) as door:
        assert "does not know this key" in door.reported(door.knock(ROBOT))
        assert "does not know this key" in door.reported(door.knock(ROBOT))
        assert (door.came, +door.gate.refused) == ([], {"gate: KeyError": 2})


def test_server_without_an_authenticator_admits_nobody(tmp_path):
    """CURVE alone would admit any key; ZAP_ENFORCE_DOMAIN makes it ask, and nothing answers."""
    with Door(tmp_path, server_gate=False) as door:
        assert not any(door.hears(pair) for pair in (DESK, ROBOT, STRANGER))
        assert not door.came


def test_idle_or_closed_authenticator_admits_nobody(door):
    serve, door.gate.serve = door.gate.serve, lambda: None
    assert not door.hears(DESK)
    door.gate.serve = serve
    assert door.admits(VIEWER).name == "viewer"
    door.gate.close()
    before = len(door.came)
    assert not door.hears(ROBOT)
    assert len(door.came) <= before + 1  # the one that had waited


def test_malformed_zap_requests_are_never_accepted(door):
    """Malformed requests from within the context, with seed 5."""
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


@pytest.mark.alone
def test_self_test_passes_and_counts_nothing(door):
    began_s = time.monotonic()
    door.gate.self_test(door.address)
    assert time.monotonic() - began_s < 2.0  # It ends with the refusals, not with its timeout.
    for _ in range(5):
        door.turn()
    assert not door.gate.refused
    assert door.admits(ROBOT).name == "robot"


def test_self_test_fails_if_an_unknown_key_is_admitted(tmp_path):
    with Door(tmp_path, gate=_LetsIn) as door, pytest.raises(NetworkError, match=r"accepts a node with unknown key"):
        door.gate.self_test(door.address)


def test_self_test_fails_if_a_node_without_a_key_is_admitted(door):
    past = sockets.server(door.context, LOOPBACK, keys=None)
    with pytest.raises(NetworkError, match=r"accepts a node with no key"):
        door.gate.self_test(sockets.bound(past))
    past.close()


def test_self_test_fails_without_an_answer(door, monkeypatch):
    monkeypatch.setattr("ertis_numba.network.zap_authenticator._SELF_TEST_S", 0.2)
    with pytest.raises(NetworkError, match=r"did not refuse a node with no key within 0\.2 s; start it when"):
        door.gate.self_test("tcp://127.0.0.1:1")


def test_context_has_one_authenticator(door):
    with pytest.raises(ArgumentError, match="the context has an authenticator already; create one per context"):
        ZapAuthenticator(door.context, door.keys)
