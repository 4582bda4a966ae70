"""What 'ertis doctor' finds, and what it says to do."""

import json
import os

import pytest
from click.testing import CliRunner
from ertis_cli import _diagnosis
from ertis_cli.main import cli

from ertis_numba import kernels
from ertis_numba.devices.ports import Port
from ertis_numba.errors import DeviceError
from ertis_numba.network.keys import KeyPair


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
        ("bad", "5 MB/s durably, the slowest 5 MB in 1000 ms: less than a sensor at 20 Hz",
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
    assert (state, "may not be opened by you" in text) == ("bad", True)
    assert remedy.startswith("run 'sudo usermod -aG ")


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
    assert (state, "others may use it" in text) == ("bad", True)
    assert "chmod 600" in remedy


def test_what_is_broken_hides_nothing_else(doctor, monkeypatch):
    def breaks(_):
        raise RuntimeError("of all things")
        yield

    monkeypatch.setitem(_diagnosis.CHECKS, "gpu", breaks)
    found = doctor()
    assert found["gpu"] == [("bad", "could not be looked at: of all things", "tell its authors")]
    assert "disk" in found


def test_for_people(tmp_path):
    done = CliRunner().invoke(cli, ["doctor", "--folder", str(tmp_path)])
    lines = done.stdout.splitlines()
    assert lines[0].split() == ["what", "found", "what", "to", "do"]
    assert any(line.startswith("ok") for line in lines)
    refused = CliRunner().invoke(cli, ["doctor", "--folder", str(tmp_path / "none")])
    assert refused.exit_code == 1
    assert "is no folder; give one that is there" in refused.output
