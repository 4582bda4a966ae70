"""Findings of 'ertis doctor' and their remedies."""

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
from ertis_numba.base.errors import DeviceError
from ertis_numba.devices.ports import Port
from ertis_numba.network.keys import KeyPair
from tests.release import FOR_AUTHORS

permission = vars(_diagnosis)["_permission"]


@pytest.fixture
def doctor(tmp_path, monkeypatch):
    """Run 'ertis doctor' in an empty folder and return its findings by name."""
    monkeypatch.setenv("ERTIS_KEYS_DIR", str(tmp_path / "keys"))
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))

    def run(*options):
        done = CliRunner().invoke(cli, ["doctor", "--json", "--folder", str(tmp_path), *options])
        report = json.loads(done.stdout)
        found = {}
        for each in report["findings"]:
            found.setdefault(each["check"], []).append((each["state"], each["text"], each["remedy"]))
        assert report["problems"] == sum(each["state"] == "bad" for each in report["findings"])
        assert done.exit_code == (report["problems"] > 0)
        return found

    return run


def test_doctor_reports_a_working_installation(doctor):
    found = doctor()
    for check in ("ertis", "libraries", "instructions", "processing"):
        assert {state for state, _, _ in found[check]} == {"good"}
    assert "numba" in found["libraries"][0][1]
    assert found["instructions"][0][1].startswith(f"{kernels.load('cpu').instruction_set}: ")
    assert "an image of 90 directions takes" in found["processing"][0][1]
    assert "MB/s durably" in found["disk"][0][1]
    assert all(remedy for each in found.values() for state, _, remedy in each if state != "good")


def test_doctor_notes_the_workqueue_threading_layer(doctor, monkeypatch):
    monkeypatch.setattr(_diagnosis, "_threading_layer", lambda: "workqueue")
    assert doctor()["threads"][0][0] == "note"
    assert "tbb" in doctor()["threads"][0][2]


def test_doctor_reports_a_slow_disk(doctor, monkeypatch):
    monkeypatch.setattr(_diagnosis, "_commits_s", lambda _: [1.0] * 3)
    assert doctor()["disk"] == [
        ("bad", "5 MB/s durably, slowest 5 MB in 1000 ms: less than one sensor at 20 Hz",
         "record to another disk, or at a lower rate"),
    ]  # fmt: skip


def test_doctor_reports_a_read_only_disk(doctor, monkeypatch):
    def fails(_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(_diagnosis, "_commits_s", fails)
    assert doctor()["disk"][0][0] == "bad"


def test_doctor_reports_a_port_without_permission(doctor, monkeypatch, tmp_path):
    path = tmp_path / "ttyACM0"
    path.touch()
    port = Port(path=str(path), link="", serial_number="123", description="eRTIS")
    monkeypatch.setattr("ertis_numba.devices.ports.find_ports", lambda: [port])
    assert doctor()["sensors"][0][0] == "good"
    may = os.access
    monkeypatch.setattr(os, "access", lambda which, *how: which != str(path) and may(which, *how))
    state, text, remedy = doctor()["sensors"][0]
    assert (state, "lack permission to open" in text) == ("bad", True)
    assert remedy == permission(path, "123")


@pytest.mark.skipif(not hasattr(os, "getgid"), reason="groups are those of POSIX")
@pytest.mark.parametrize(
    ("serial", "rule"),
    [("207A", r'ENV\{ID_SERIAL_SHORT\}=="207A"'), ("", r'KERNEL=="ttyACM\*"'), ('a"b', r'KERNEL=="ttyACM\*"')],
)
@pytest.mark.parametrize(
    ("group_id", "mode", "remedy"),
    [
        (20, 0o660, "run 'sudo usermod -aG serial $USER' and log in again"),
        (0, 0o660, "udev"),  # joining the root group would grant root access
        (20, 0o640, "udev"),  # the group may not write
        (20, 0o600, "udev"),
        (77, 0o660, "udev"),  # the group has no name
        (os.getgid() or 21, 0o660, "udev"),  # a group of the user, which still has no access
    ],
)
def test_doctor_port_remedy_suits_group_and_mode(monkeypatch, group_id, mode, remedy, serial, rule):
    import grp  # noqa: PLC0415  not on every system

    def named(number):
        return SimpleNamespace(gr_name={0: "root", 20: "serial", 21: "mine"}[number])

    monkeypatch.setattr(grp, "getgrgid", named)
    monkeypatch.setattr(os, "getgroups", lambda: [21, os.getgid()])
    monkeypatch.setattr(_diagnosis.sys, "platform", "linux")
    reported = permission(
        SimpleNamespace(stat=lambda: SimpleNamespace(st_gid=group_id, st_mode=0o20000 | mode)), serial
    )
    if remedy != "udev":
        assert reported == remedy
        return
    assert "usermod -aG root" not in reported
    assert re.search(rf"""write 'SUBSYSTEM=="tty", {rule}, .*' to /etc/udev/rules.d/\S+\.rules""", reported)


def test_doctor_checks_all_extras(doctor):
    """Each extra for users is checked by one module of every package in it."""
    parser = ConfigParser()
    parser.read(Path(__file__).parents[2] / "setup.cfg")
    brought = {
        extra: {re.split(r"[\[<>=]", line)[0] for line in lines.split("\n") if line}
        for extra, lines in parser["options.extras_require"].items()
        if extra not in {"cu12", "cu13", *FOR_AUTHORS}  # GPUs have their own check
    }
    packages = packages_distributions()
    looked_at = {
        extra: {packages[name][0].replace("_", "-") for name in names}
        for extra, names in vars(_diagnosis)["_EXTRAS"].items()
    }
    assert looked_at == brought
    assert {f"extra {extra}" for extra in brought} <= set(doctor())


def test_doctor_notes_an_incomplete_extra(doctor, monkeypatch):
    there = _diagnosis.importlib.util.find_spec
    monkeypatch.setattr(
        _diagnosis.importlib.util, "find_spec", lambda name: None if name == "websockets" else there(name)
    )
    assert doctor()["extra view"] == [("note", "not installed", "optional: pip install 'ertis-numba[view]'")]


def test_doctor_reports_an_unusable_gpu(doctor, monkeypatch):
    def fails(device):
        if device == "cuda":
            raise DeviceError("no driver; install one")
        return real(device)

    real = kernels.load
    monkeypatch.setattr(kernels, "load", fails)
    monkeypatch.setattr(_diagnosis.importlib.util, "find_spec", lambda name: name)
    state, text, remedy = doctor()["GPU"][0]
    assert (state in {"note", "bad"}, text, remedy) == (True, "no driver", "install one")


def test_doctor_reports_keys_readable_by_other_users(doctor, tmp_path):
    secret, _ = KeyPair.new("mine").save(tmp_path / "keys")
    assert doctor()["keys"][0][0] == "good"
    secret.chmod(0o644)
    state, text, remedy = doctor()["keys"][0]
    assert (state, "other users may read it" in text) == ("bad", True)
    assert "chmod 600" in remedy


def test_doctor_continues_after_a_failing_check(doctor, monkeypatch):
    def breaks(_):
        raise RuntimeError("of all things")
        yield

    monkeypatch.setitem(_diagnosis.CHECKS, "gpu", breaks)
    found = doctor()
    assert found["gpu"] == [("bad", "check failed: RuntimeError: of all things", "report this as a bug")]
    assert "disk" in found


def test_doctor_repeats_the_remedy_of_an_error_of_the_package(doctor, monkeypatch):
    def refuses(_):
        raise DeviceError("no folder for compiled kernels is writable (full; read-only); set NUMBA_CACHE_DIR")
        yield

    monkeypatch.setitem(_diagnosis.CHECKS, "processor", refuses)
    text = "no folder for compiled kernels is writable (full; read-only)"
    assert doctor()["processor"] == [("bad", text, "set NUMBA_CACHE_DIR")]


def test_doctor_names_a_kernel_cache_that_is_lost(doctor, monkeypatch, tmp_path):
    monkeypatch.setattr("ertis_numba.kernels._cpu.cache_folder", lambda: str(tmp_path / "kernels"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert doctor()["kernel cache"] == [
        ("note", str(tmp_path / "kernels"), "set NUMBA_CACHE_DIR to a writable folder that is kept")
    ]


def test_doctor_prints_a_table_and_rejects_missing_folder(tmp_path):
    done = CliRunner().invoke(cli, ["doctor", "--folder", str(tmp_path)])
    lines = done.stdout.splitlines()
    assert lines[0].split() == ["check", "found", "remedy"]
    assert any(line.startswith("ok") for line in lines)
    refused = CliRunner().invoke(cli, ["doctor", "--folder", str(tmp_path / "none")])
    assert refused.exit_code == 1
    assert "is not a folder; choose an existing folder" in refused.output
