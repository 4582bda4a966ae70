"""Authentication while the allow list changes, is written, or cannot be read."""

import time
from types import SimpleNamespace

import pytest
import zmq

from ertis_numba.base.errors import SettingsError
from ertis_numba.network.allow_list import Permission
from ertis_numba.network.keys import ServerKeys
from ertis_numba.network.zap_authenticator import ZapAuthenticator
from tests.zap_clients import CENTRAL, DESK, LISTED, ROBOT, STRANGER, Door


@pytest.fixture
def door(tmp_path):
    with Door(tmp_path) as made:
        yield made


def _replace(door, listed):
    listed.save(door.list)


# The list changes


def test_removed_key_is_disconnected_within_a_second(door, monkeypatch):
    clock = SimpleNamespace(now_s=time.monotonic(), monotonic=lambda: clock.now_s)
    monkeypatch.setattr("ertis_numba.network.zap_authenticator.time", clock)
    client = door.knock(ROBOT)
    assert door.until(lambda: door.came)
    assert door.came[-1][1].name == "robot"
    _replace(door, LISTED.remove("robot"))
    clock.now_s += 0.99
    door.say(client, b"more")
    assert door.until(lambda: len(door.came) == 2)
    assert door.came[-1][1] is None
    assert door.until(lambda: door.changed == 1)
    assert door.gate.refused["removed key"] == 1
    before = len(door.came)
    door.say(client, b"still")
    assert door.until(lambda: len(door.came) > before)
    assert door.came[-1][1] is None
    assert door.admits(ROBOT) is None
    assert door.gate.refused["unknown key"] == 1


def test_newly_listed_key_is_admitted(door):
    assert door.admits(STRANGER) is None
    _replace(door, LISTED.allow(Permission(name="stranger", public=STRANGER.public, role="application")))
    assert door.until(lambda: door.changed == 1)
    assert door.admits(STRANGER).name == "stranger"


def test_connection_has_the_present_role_and_serials_of_its_key(door):
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
def test_unreadable_allow_list_admits_nobody(door, spoil):
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


def test_allow_list_being_written_is_read_again(door):
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
def test_invalid_allow_list_is_reported_at_the_start(tmp_path, text):
    path = tmp_path / "allow.toml"
    if text is not None:
        path.write_text(text)
    with zmq.Context() as context, pytest.raises(SettingsError, match=r"allow\.toml"):
        ZapAuthenticator(context, ServerKeys(CENTRAL, path))
