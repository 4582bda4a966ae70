"""Addresses, keys, allow lists, and the commands that create and change them."""

import contextlib
import json
import os
import stat
import threading
from pathlib import Path

import pytest
import zmq
from click.testing import CliRunner
from ertis_cli import _network
from ertis_cli.main import cli
from hypothesis import given, strategies as st

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.network import addresses
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys, default_folder, public_key
from ertis_numba.network.zap_authenticator import ZapAuthenticator

PAIR = KeyPair.new("robot")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_KEYS_DIR", str(tmp_path / "keys"))
    return tmp_path / "keys"


def _permission(**changes):
    return Permission(
        **{"name": "robot", "public": PAIR.public, "role": "sensor", "serials": ("front", "left")} | changes
    )


# Addresses


@pytest.mark.parametrize(
    ("text", "loopback"),
    [
        ("tcp://127.0.0.1:5601", True),
        ("tcp://127.8.9.10:0", True),
        ("tcp://localhost:*", True),
        ("tcp://[::1]:5601", True),
        ("tcp://[::ffff:127.0.0.1]:5601", False),
        ("tcp://0.0.0.0:5601", False),
        ("tcp://*:5601", False),
        ("tcp://192.168.1.7:5601", False),
        ("tcp://128.0.0.1:1", False),
        ("tcp://127.1:5601", False),
        ("tcp://localhost.example.org:5601", False),
        ("tcp://127.0.0.1.example.org:5601", False),
        ("tcp://[::]:5601", False),
    ],
)
def test_only_literal_loopback_addresses_need_no_keys(text, loopback):
    endpoint = addresses.endpoint(text)
    assert endpoint == text
    assert addresses.is_loopback(endpoint) is loopback
    addresses.require_keys(endpoint, keys=object())
    if loopback:
        addresses.require_keys(endpoint, keys=None)
    else:
        with pytest.raises(
            ArgumentError, match="can be reached from other machines, but there are no keys; create keys"
        ):
            addresses.require_keys(endpoint, keys=None)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "127.0.0.1:5601",
        "tcp://127.0.0.1",
        "tcp://127.0.0.1:",
        "tcp://:5601",
        "tcp://127.0.0.1:65536",
        "tcp://127.0.0.1:5601/",
        "tcp://127.0.0.1:5601\n",
        "tcp://a b:5601",
        "tcp://eth0;127.0.0.1:5601",
        "tcp://[::1:5601",
        "tcp://[1.2.3]:5601",
        "ipc:///tmp/socket",
        "inproc://zeromq.zap.01",
        "udp://127.0.0.1:5601",
        "tcp://127.0.0.1:٥٦٠١",
        5,
    ],
)
def test_invalid_address_is_refused(text):
    with pytest.raises(ArgumentError, match="cannot be used") as caught:
        addresses.endpoint(text)
    assert len(str(caught.value).splitlines()) == 1


@given(st.text(max_size=40))
def test_any_text_is_an_address_or_refused(text):
    with contextlib.suppress(ArgumentError):
        assert addresses.endpoint("tcp://" + text).startswith("tcp://")


# Keys


def test_saved_keys_are_read_back_and_private(folder):
    secret, public = PAIR.save(folder)
    assert KeyPair.load(secret) == PAIR
    assert public_key(public) == (PAIR.public, "robot")
    assert public_key(PAIR.public) == (PAIR.public, "")
    assert PAIR.secret not in public.read_text()
    assert PAIR.secret not in repr(PAIR)
    assert PAIR.secret not in repr(ClientKeys(PAIR, PAIR.public))
    assert [stat.S_IMODE(path.stat().st_mode) for path in (folder, secret)] == [0o700, 0o600]
    assert sorted(path.name for path in folder.iterdir()) == ["robot.public.toml", "robot.secret.toml"]


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o610, 0o602])
def test_secret_key_readable_by_others_is_refused(folder, mode):
    secret, _ = PAIR.save(folder)
    secret.chmod(mode)
    with pytest.raises(SettingsError, match=f"other users may read it \\(mode {mode:04o}\\); run 'chmod 600"):
        KeyPair.load(secret)


def test_secret_key_is_not_written_to_a_shared_folder(folder):
    folder.mkdir(mode=0o700)
    folder.chmod(0o750)
    with pytest.raises(ArgumentError, match=r"other users can access .* \(mode 0750\); run 'chmod 700"):
        PAIR.save(folder)
    assert not list(folder.iterdir())


def test_secret_key_in_a_shared_folder_is_refused(folder):
    secret, _ = PAIR.save(folder)
    folder.chmod(0o755)
    with pytest.raises(
        SettingsError, match=f"other users may use its folder \\(mode 0755\\); run 'chmod 700 {folder}'"
    ):
        KeyPair.load(secret)


def test_keys_are_never_overwritten(folder):
    PAIR.save(folder)
    with pytest.raises(ArgumentError, match="exists; choose another name"):
        KeyPair.new("robot").save(folder)
    assert KeyPair.load(folder / "robot.secret.toml") == PAIR


def test_secret_key_file_is_private_from_its_creation(folder, monkeypatch):
    modes, make = [], os.open

    def opened(path, flags, mode=0o777, **options):
        descriptor = make(path, flags, mode, **options)
        if flags & os.O_CREAT:
            modes.append(stat.S_IMODE(os.fstat(descriptor).st_mode))
        return descriptor

    monkeypatch.setattr(os, "open", opened)
    PAIR.save(folder)
    assert modes[0] == 0o600


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("", "is empty"),
        ('name = "robot"\npublic = "x"\nsecret = "y"\n', "'x' is not a key"),
        (f'name = "robot"\npublic = "{PAIR.public}"\nsecret = "{KeyPair.new("other").secret}"\n', "does not belong"),
        (f'name = "../robot"\npublic = "{PAIR.public}"\nsecret = "{PAIR.secret}"\n', "cannot be used"),
        ("name = ", "robot.secret.toml"),
    ],
    ids=["empty", "no_keys", "not_its_own", "path", "no_toml"],
)
def test_file_without_keys_is_refused(tmp_path, text, reported):
    path = tmp_path / "robot.secret.toml"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(SettingsError, match=reported) as caught:
        KeyPair.load(path)
    assert PAIR.secret not in str(caught.value)


def test_missing_key_file_is_reported(tmp_path):
    with pytest.raises(SettingsError, match="create keys with 'ertis keys new'"):
        KeyPair.load(tmp_path / "none")


@pytest.mark.parametrize("name", ["", "a/b", "..", "a b", "x" * 65, "-x", "ä"])
def test_key_name_unfit_for_a_file_is_refused(name):
    with pytest.raises(ArgumentError, match="cannot be used"):
        KeyPair.new(name)


@pytest.mark.parametrize(
    "key",
    ["", "short", "~" * 40, "#" * 40, PAIR.public[:-1], PAIR.public + "0"],
    ids=["none", "word", "no_z85", "too_much", "39", "41"],
)
def test_invalid_key_is_refused(key):
    with pytest.raises(ArgumentError, match="use the 40 characters from 'ertis keys list'"):
        ClientKeys(PAIR, key)
    with pytest.raises(ArgumentError, match="is not a key"):
        _permission(public=key)


def test_secret_key_is_refused_as_a_public_key(folder):
    secret, _ = PAIR.save(folder)
    with pytest.raises(SettingsError, match="contains a secret key"):
        public_key(secret)


# Allow lists


def _flipped(path):
    """Flip each bit of a file in turn."""
    whole = path.read_bytes()
    for bit in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        yield


def test_flipped_bit_of_an_allow_list_is_detected(tmp_path):
    path = tmp_path / "allow.toml"
    listed = AllowList().allow(_permission())
    listed.save(path)
    n_refused = 0
    for _ in _flipped(path):
        try:
            assert AllowList.load(path) == listed
        except SettingsError:
            n_refused += 1
    assert n_refused > 1000


def test_flipped_bit_of_a_key_file_is_detected(folder):
    secret, public = PAIR.save(folder)
    for path, read, wanted in (
        (secret, KeyPair.load, PAIR),
        (public, public_key, (PAIR.public, PAIR.name)),
    ):
        for _ in _flipped(path):
            with contextlib.suppress(SettingsError):
                assert read(path) == wanted


def test_truncated_allow_list_is_refused(tmp_path):
    path = tmp_path / "allow.toml"
    AllowList().allow(_permission()).save(path)
    whole = path.read_bytes()
    for n_bytes in range(len(whole) - 1):
        path.write_bytes(whole[:n_bytes])
        with pytest.raises(SettingsError):
            AllowList.load(path)


def test_allow_list_edited_by_hand_is_refused_with_a_remedy(tmp_path):
    path = tmp_path / "allow.toml"
    AllowList().allow(_permission()).save(path)
    path.write_text(path.read_text().replace('"left"', '"rear"'))
    with pytest.raises(
        SettingsError,
        match=r"the file is damaged or was edited by hand\. Review its content",
    ):
        AllowList.load(path)
    path.write_text(path.read_text().partition("\n")[2])
    assert AllowList.load(path).keys[0].serials == ("front", "rear")


def test_allow_list_is_read_as_it_was_saved(tmp_path):
    other = Permission(name="viewer", public=KeyPair.new("viewer").public, role="application")
    listed = AllowList().allow(_permission()).allow(other)
    listed.save(tmp_path / "allow.toml")
    assert AllowList.load(tmp_path / "allow.toml") == listed
    assert listed.find(PAIR.public) == _permission()
    assert listed.find(KeyPair.new("x").public) is None
    assert listed.remove("robot").keys == listed.remove(PAIR.public).keys == (other,)


@pytest.mark.parametrize(("what", "mode"), [("allow.toml", 0o664), ("allow.toml", 0o646), (".", 0o775)])
def test_allow_list_writable_by_others_is_refused(tmp_path, what, mode):
    path = tmp_path / "allow.toml"
    AllowList().allow(_permission()).save(path)
    (tmp_path / what).chmod(mode)
    with pytest.raises(SettingsError, match=f"other users may change it.* \\(mode {mode:04o}\\); run 'chmod go-w"):
        AllowList.load(path)
    with zmq.Context() as context, pytest.raises(SettingsError, match="other users may change"):
        ZapAuthenticator(context, ServerKeys(PAIR, path))


def test_allow_list_is_private_for_any_umask(tmp_path):
    before = os.umask(0)
    try:
        AllowList().save(tmp_path / "allow.toml")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "allow.toml").stat().st_mode) == 0o644


def test_concurrent_changes_of_an_allow_list_are_all_kept(tmp_path):
    path, threads = tmp_path / "allow.toml", []
    for number in range(12):
        permission = _permission(name=f"n{number}", public=KeyPair.new("x").public)
        threads.append(threading.Thread(target=AllowList.change, args=(path, _slowly(permission))))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(each.name for each in AllowList.load(path).keys) == sorted(f"n{number}" for number in range(12))


def _slowly(permission):
    def change(before):
        threading.Event().wait(0.01)
        return before.allow(permission)

    return change


def test_allowing_a_key_again_replaces_its_permission():
    listed = AllowList().allow(_permission()).allow(_permission(serials=("rear",)))
    assert listed.keys == (_permission(serials=("rear",)),)


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"serials": ()}, "sensor without serials; name the sensors"),
        ({"serials": ("*",)}, "sensor name '\\*' cannot name a group"),
        ({"serials": ("front", "../x")}, "cannot name a group in a file"),
        ({"role": "application"}, "robot has serials but is not a sensor"),
        ({"role": "admin"}, "robot has serials but is not a sensor"),
        ({"role": "root", "serials": ()}, "role 'root' is unknown"),
        ({"name": "a b"}, "cannot be used"),
    ],
)
def test_inconsistent_permission_is_refused(changes, reported):
    with pytest.raises(ArgumentError, match=reported):
        _permission(**changes)


@pytest.mark.parametrize("what", ["name", "public"])
def test_allow_list_has_each_key_once(what):
    changes = {"name": "second", "public": KeyPair.new("x").public} | {what: getattr(_permission(), what)}
    with pytest.raises(ArgumentError, match="is listed twice"):
        AllowList(keys=(_permission(), _permission(**changes)))


def test_allow_list_refuses_invalid_operations():
    listed = AllowList().allow(_permission())
    with pytest.raises(ArgumentError, match="another key is listed as 'robot'"):
        listed.allow(_permission(public=KeyPair.new("x").public))
    with pytest.raises(ArgumentError, match="key 'robo' is unknown \\(did you mean 'robot'"):
        listed.remove("robo")


@pytest.mark.parametrize(
    ("role", "sends", "receives"),
    [("sensor", {"front"}, False), ("application", set(), True), ("admin", {"front", "rear"}, True)],
)
def test_each_role_has_its_permissions(role, sends, receives):
    permission = _permission(role=role, serials=("front",) if role == "sensor" else ())
    assert {sensor for sensor in ("front", "rear") if permission.may_send(sensor)} == sends
    assert permission.may_receive is receives


# Commands


def _run(*arguments):
    result = CliRunner().invoke(cli, ["keys", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_keys_are_made_allowed_listed_and_removed(folder):
    made = json.loads(_run("new", "robot", "--json"))
    assert KeyPair.load(made["secret_file"]).public == made["public"]
    allowed = json.loads(
        _run("allow", made["public_file"], "--role", "sensor", "--serial", "front", "--serial", "left", "--json")
    )
    assert allowed["keys"] == [
        {"name": "robot", "public": made["public"], "role": "sensor", "serials": ["front", "left"]}
    ]
    assert json.loads(_run("list", "--json"))["keys"] == allowed["keys"]
    assert _run("list") == f"robot  sensor       {made['public']}  front left\n"
    assert AllowList.load(folder / "allow.toml").find(made["public"]).serials == ("front", "left")
    assert json.loads(_run("remove", "robot", "--json"))["removed"] == allowed["keys"]
    assert AllowList.load(folder / "allow.toml").keys == ()


def test_secret_key_is_never_printed(folder):
    printed = _run("new", "robot") + _run("allow", str(folder / "robot.public.toml"), "--role", "admin") + _run("list")
    assert KeyPair.load(folder / "robot.secret.toml").secret not in printed


def test_keys_never_start_with_a_hyphen(monkeypatch):
    drawn = zmq.curve_keypair()
    while drawn[0].startswith(b"-"):
        drawn = zmq.curve_keypair()
    dashed = b"-" + drawn[0][1:], drawn[1]
    given = iter([dashed, dashed, drawn])
    monkeypatch.setattr(zmq, "curve_keypair", lambda: next(given))
    assert KeyPair.new("robot").public == drawn[0].decode()


def test_key_given_as_text_needs_a_name(tmp_path):
    result = CliRunner().invoke(cli, ["keys", "allow", PAIR.public, "--role", "admin"])
    assert result.exit_code == 2
    assert "add --name" in result.output
    _run("allow", PAIR.public, "--role", "admin", "--name", "desk", "--list", str(tmp_path / "other.toml"))
    assert AllowList.load(tmp_path / "other.toml").find(PAIR.public).name == "desk"


def test_keys_may_be_given_by_file_or_by_name(folder):
    secret, public = PAIR.save(folder)
    wanted = ClientKeys(PAIR, PAIR.public)
    assert _network.client_keys("robot", "robot") == wanted
    assert _network.client_keys(str(secret), str(public)) == wanted
    assert _network.client_keys(str(secret), PAIR.public) == wanted
    assert _network.client_keys(None, None) is None
    assert _network.server_keys(None, None) is None
    server = _network.server_keys("robot", None)
    assert (server.pair, server.allow) == (PAIR, default_folder() / "allow.toml")


@pytest.mark.parametrize(("key", "server_key"), [("robot", None), (None, "robot")])
def test_key_without_server_key_is_refused(folder, key, server_key):
    PAIR.save(folder)
    with pytest.raises(Exception, match="use both, or neither"):
        _network.client_keys(key, server_key)


def test_allow_list_without_a_server_key_is_refused(tmp_path):
    with pytest.raises(Exception, match="--allow has no effect without --key"):
        _network.server_keys(None, tmp_path / "allow.toml")


def _give_to_another_user(monkeypatch, path):
    """Make a file belong to another user."""
    if os.geteuid() == 0:
        os.lchown(path, 12345, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: 12345)


def test_allow_list_of_another_user_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "allow.toml"
    AllowList().allow(_permission()).save(path)
    _give_to_another_user(monkeypatch, path)
    with pytest.raises(SettingsError, match=r"other users may change .*\(owned by user \d+\); run 'chown"):
        AllowList.load(path)


def test_secret_key_of_another_user_is_refused(tmp_path, monkeypatch):
    secret, _ = PAIR.save(tmp_path / "keys")
    _give_to_another_user(monkeypatch, secret)
    with pytest.raises(SettingsError, match=r"contains a secret, but other users may change .*\(owned by user \d+\)"):
        KeyPair.load(secret)


@pytest.mark.parametrize("depth", [1, 2])
def test_allow_list_linked_through_a_shared_folder_is_refused(tmp_path, depth):
    """Other users may replace a link in a shared folder, even one that leads back to a private folder."""
    (tmp_path / "open").mkdir()
    (tmp_path / "own").mkdir()
    AllowList().allow(_permission()).save(tmp_path / "open" / "allow.toml")
    AllowList().allow(_permission()).save(tmp_path / "own" / "real.toml")
    if depth == 2:
        (tmp_path / "open" / "allow.toml").unlink()
        (tmp_path / "open" / "allow.toml").symlink_to(tmp_path / "own" / "real.toml")
    (tmp_path / "open").chmod(0o777)
    link = tmp_path / "own" / "allow.toml"
    link.symlink_to(Path("..") / "open" / "allow.toml")
    with pytest.raises(
        SettingsError, match=rf"other users may change {tmp_path / 'open'} \(mode 0777\); run 'chmod go-w"
    ):
        AllowList.load(link)
    (tmp_path / "open").chmod(0o755)
    assert AllowList.load(link).keys == (_permission(),)


def test_allow_list_below_a_shared_folder_is_refused(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    path = tmp_path / "a" / "b" / "allow.toml"
    AllowList().save(path)
    (tmp_path / "a").chmod(0o777)
    with pytest.raises(SettingsError, match=rf"other users may change {tmp_path / 'a'} \(mode 0777\)"):
        AllowList.load(path)
    (tmp_path / "a").chmod(0o1777)  # the sticky bit, as in /tmp, keeps users from replacing files of others
    AllowList.load(path)


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("key", ["robot.public.toml", "robot"])
def test_key_of_the_key_folder_is_allowed_by_its_file_or_name(tmp_path, monkeypatch, key):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    made = json.loads(_run("new", "robot", "--json"))
    assert json.loads(_run("allow", key, "--role", "admin", "--json"))["keys"][0]["public"] == made["public"]
    other = KeyPair.new("other")
    _, file = other.save(tmp_path / "other")
    Path("robot.public.toml").write_bytes(file.read_bytes())  # A file here comes before one of the key folder.
    assert other.public in _run("allow", "robot.public.toml", "--role", "admin")


@pytest.mark.usefixtures("folder")
def test_key_that_is_nowhere_is_refused():
    done = CliRunner().invoke(cli, ["keys", "allow", "none.public.toml", "--role", "admin"])
    assert (done.exit_code, "is neither a public key nor a file with one" in done.output) == (1, True)


@pytest.mark.usefixtures("folder")
def test_empty_key_is_refused():
    done = CliRunner().invoke(cli, ["keys", "allow", "", "--role", "admin"])
    assert (done.exit_code, "is empty; write a value" in done.output) == (2, True)
