"""Keys of a central node: a key is accepted only while it is listed, and only for its role and serials."""

import select

import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.network import messages
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.central_node import Archive, CentralNode
from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys
from ertis_numba.network.messages import Refused, Report, Welcome
from tests.central import Node, running, stored
from tests.journals import entries


def keys(folder, *permissions):
    server = KeyPair.new("server")
    AllowList(keys=permissions).save(folder / "allow.toml")
    return ServerKeys(server, folder / "allow.toml")


def permission(pair, role="sensor", serials=("left",)):
    return Permission(name=pair.name, public=pair.public, role=role, serials=serials if role == "sensor" else ())


def test_key_is_limited_to_its_serials_and_role(tmp_path):
    pairs = [KeyPair.new(name) for name in ("node", "screen")]
    given = keys(tmp_path, permission(pairs[0]), permission(pairs[1], "application"))
    with running(tmp_path / "a", keys=given) as central:
        sensor, screen = (ClientKeys(pair, given.pair.public) for pair in pairs)
        with Node(central.address, sensor) as node, Node(central.address, screen) as listener:
            assert node.hello("right").code == "serial"
            assert isinstance(node.hello("left"), Welcome)
            node.measure(*entries(1), sensor="right")
            assert node.hear(Refused).code == "serial"
            node.send(messages.AskStatus())
            assert node.hear(Refused).code == "role"
            assert listener.hello("left").code == "role"
            listener.send(messages.AskStatus())
            assert listener.hear() == Report()
            node.measure(*entries(1))
            node.hear_settled(10)
    assert central.latest.refused["serial"] == 2
    assert central.latest.refused["role"] == 2


def test_removed_key_is_refused(tmp_path):
    pair = KeyPair.new("node")
    given = keys(tmp_path, permission(pair))
    known = ClientKeys(pair, given.pair.public)
    with running(tmp_path / "a", keys=given) as central, Node(central.address, known) as node:
        node.hello()
        node.measure(*entries(1))
        node.hear_settled(10)
        AllowList(keys=()).save(given.allow)
        while not any(event["event"] == "left" for event in central.events):
            node.socket.poll(20)
        node.measure(*entries(1, first=11))
        assert node.hear(Refused).code == "role"
    assert central.latest.refused["removed key"] >= 1
    assert len(stored(tmp_path / "a")[0]) == 1


def test_central_node_without_keys_rejects_a_public_address(tmp_path):
    with (
        pytest.raises(ArgumentError, match="there are no keys"),
        CentralNode("tcp://0.0.0.0:0", archive=Archive(tmp_path)),
    ):
        pass


def test_invalid_allow_list_is_reported_until_repaired(tmp_path):
    pair = KeyPair.new("node")
    given = keys(tmp_path, permission(pair))
    listed = given.allow.read_bytes()
    with running(tmp_path / "a", keys=given) as central:
        for number, content in enumerate((b"[", listed)):
            given.allow.write_bytes(content)
            while len(reported := [event["text"] for event in central.events if event["event"] == "keys"]) <= number:
                select.select([], [], [], 0.01)
            assert central.status().keys_note == (reported[0] if content == b"[" else "")
    assert str(given.allow) in reported[0]
    assert reported[1] == "the allow list can be used again"
