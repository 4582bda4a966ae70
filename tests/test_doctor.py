"""What 'ertis doctor' finds, and what it says to do."""

import json
import os
import re
from configparser import ConfigParser
from importlib.metadata import packages_distributions
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner
from ertis_cli import _diagnosis
from ertis_cli.main import cli

from ertis_numba import kernels
from ertis_numba.devices.ports import Port
from ertis_numba.errors import DeviceError
from ertis_numba.network.keys import KeyPair

permission = vars(_diagnosis)["_permission"]


@pytest.fixture
def doctor(tmp_path, monkeypatch):
    """Run it in a folder of its own, with what is found by its name."""
    monkeypatch.setenv("ERTIS_KEYS_DIR", str(tmp_path / "keys"))
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))

    def run(*options):
        done = CliRunner().invoke(cli, ["doctor", "--json", "--folder", str(tmp_path), *options])
        report = json.loads(done.stdout)
        found = {}
        for each in report["findings"]:
            found.setdefault(each["what"], []).append((each["state"], each["text"], each["remedy"]))
        assert report["problems"] == sum(each["state"] == "bad" for each in report["findings"])
        assert done.exit_code == (report["problems"] > 0)
        return found

    return run


def test_what_works(doctor):
    found = doctor()
    for what in ("ertis", "libraries", "processing"):
        assert {state for state, _, _ in found[what]} == {"good"}
    assert "numba" in found["libraries"][0][1]
    assert "an image of 90 directions takes" in found["processing"][0][1]
    assert "MB/s durably" in found["disk"][0][1]
    assert all(remedy for each in found.values() for state, _, remedy in each if state != "good")


def test_threads_that_take_turns(doctor, monkeypatch):
    monkeypatch.setattr(_diagnosis, "_threading_layer", lambda: "workqueue")
    assert doctor()["threads"][0][0] == "note"
    assert "tbb" in doctor()["threads"][0][2]


def test_a_slow_disk(doctor, monkeypatch):
    monkeypatch.setattr(_diagnosis, "_commits_s", lambda _: [1.0] * 3)
    assert doctor()["disk"] == [
        ("bad", "5 MB/s durably, slowest 5 MB in 1000 ms: less than one sensor at 20 Hz",
         "record to another disk, or at a lower rate"),
    ]  # fmt: skip


def test_a_disk_that_cannot_be_written(doctor, monkeypatch):
    def fails(_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(_diagnosis, "_commits_s", fails)
    assert doctor()["disk"][0][0] == "bad"


def test_a_port_that_may_not_be_opened(doctor, monkeypatch, tmp_path):
    path = tmp_path / "ttyACM0"
    path.touch()
    port = Port(path=str(path), link="", serial_number="123", description="eRTIS", emulated=True)
    monkeypatch.setattr("ertis_numba.devices.ports.find_ports", lambda: [port])
    assert doctor()["sensors"][0][0] == "good"
    may = os.access
    monkeypatch.setattr(os, "access", lambda which, *how: which != str(path) and may(which, *how))
    state, text, remedy = doctor()["sensors"][0]
    assert (state, "lack permission to open" in text) == ("bad", True)
    assert remedy == permission(path)


@pytest.mark.skipif(not hasattr(os, "getgid"), reason="groups are those of POSIX")
@pytest.mark.parametrize(
    ("group_id", "mode", "remedy"),
    [
        (20, 0o660, "run 'sudo usermod -aG serial $USER' and log in again"),
        (0, 0o660, "udev"),  # to join the group of root is to be root
        (20, 0o640, "udev"),  # whose members may not write
        (20, 0o600, "udev"),
        (77, 0o660, "udev"),  # which has no name
        (os.getgid() or 21, 0o660, "udev"),  # of which one is a member, and may not all the same
    ],
)
def test_what_would_permit_to_open_a_port(monkeypatch, group_id, mode, remedy):
    import grp  # noqa: PLC0415  not on every system

    def named(number):
        return SimpleNamespace(gr_name={0: "root", 20: "serial", 21: "mine"}[number])

    monkeypatch.setattr(grp, "getgrgid", named)
    monkeypatch.setattr(os, "getgroups", lambda: [21, os.getgid()])
    monkeypatch.setattr(_diagnosis.sys, "platform", "linux")
    reported = permission(SimpleNamespace(stat=lambda: SimpleNamespace(st_gid=group_id, st_mode=0o20000 | mode)))
    if remedy != "udev":
        assert reported == remedy
        return
    assert "usermod -aG root" not in reported
    assert re.search(r"""write 'KERNEL=="ttyACM\*", .*' to /etc/udev/rules.d/\S+\.rules""", reported)


def test_all_extras_are_looked_at(doctor):
    """Those that users have, by a module of each package that they bring."""
    parser = ConfigParser()
    parser.read(Path(__file__).parents[1] / "setup.cfg")
    brought = {
        extra: {re.split(r"[\[<>=]", line)[0] for line in lines.split("\n") if line}
        for extra, lines in parser["options.extras_require"].items()
        if extra not in {"cu12", "cu13", "test", "docs", "check"}  # a GPU is looked at, and the others are for authors
    }
    packages = packages_distributions()
    looked_at = {
        extra: {packages[name][0].replace("_", "-") for name in names}
        for extra, names in vars(_diagnosis)["_EXTRAS"].items()
    }
    assert looked_at == brought
    assert {f"extra {extra}" for extra in brought} <= set(doctor())


def test_an_extra_that_is_not_there_in_full(doctor, monkeypatch):
    there = _diagnosis.importlib.util.find_spec
    monkeypatch.setattr(
        _diagnosis.importlib.util, "find_spec", lambda name: None if name == "websockets" else there(name)
    )
    assert doctor()["extra view"] == [("note", "not installed", "optional: pip install 'ertis-numba[view]'")]


def test_a_gpu_that_cannot_be_used(doctor, monkeypatch):
    def fails(device):
        if device == "cuda":
            raise DeviceError("no driver; install one")
        return real(device)

    real = kernels.load
    monkeypatch.setattr(kernels, "load", fails)
    monkeypatch.setattr(_diagnosis.importlib.util, "find_spec", lambda name: name)
    state, text, remedy = doctor()["GPU"][0]
    assert (state in {"note", "bad"}, text, remedy) == (True, "no driver", "install one")


def test_keys_that_others_can_read(doctor, tmp_path):
    secret, _ = KeyPair.new("mine").save(tmp_path / "keys")
    assert doctor()["keys"][0][0] == "good"
    secret.chmod(0o644)
    state, text, remedy = doctor()["keys"][0]
    assert (state, "other users may read it" in text) == ("bad", True)
    assert "chmod 600" in remedy


def test_what_is_broken_hides_nothing_else(doctor, monkeypatch):
    def breaks(_):
        raise RuntimeError("of all things")
        yield

    monkeypatch.setitem(_diagnosis.CHECKS, "gpu", breaks)
    found = doctor()
    assert found["gpu"] == [("bad", "check failed: of all things", "report this as a bug")]
    assert "disk" in found


def test_for_people(tmp_path):
    done = CliRunner().invoke(cli, ["doctor", "--folder", str(tmp_path)])
    lines = done.stdout.splitlines()
    assert lines[0].split() == ["what", "found", "what", "to", "do"]
    assert any(line.startswith("ok") for line in lines)
    refused = CliRunner().invoke(cli, ["doctor", "--folder", str(tmp_path / "none")])
    assert refused.exit_code == 1
    assert "is not a folder; give an existing folder" in refused.output
