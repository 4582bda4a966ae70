"""Network commands of the tour and of docs/how-to/network.md, with other ports, hosts, sounds and grids.

The emulated sensors of the platform repeat one measurement, because rendering the scene takes longer than all other
work together. Commands that end by themselves run in this process.
"""

import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ertis_numba.devices.emulator import Emulator
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.simulation import Scene
from ertis_numba.storage import open_recording, sensor_names, write_recording
from tests.pages import page, run_here
from tests.ports import reserved_address

ROOT = Path(__file__).parents[2]
TOUR = page("tour")
PAGE = page("network")
READY = {"sensors emulate": "/dev/", "serve": '"listening"', "record": '"listening"', "capture": '"kept"'}
SENSORS = ("front", "left")
"""The sensors of the platform from which the commands capture."""


@pytest.fixture(scope="module")
def words():
    with open_recording(ROOT / "data" / "synthetic" / "reflectors.h5") as recording:
        return recording[0].data


@pytest.fixture(scope="module")
def platform(tmp_path_factory, words):
    """Recording with sensors of the platform."""
    path = tmp_path_factory.mktemp("platform") / "platform.h5"
    scene = Scene.load(ROOT / "examples" / "platform.toml")
    given = [Measurement(words, scene.sensor(name).settings(), Stamp(sensor=name)) for name in SENSORS]
    write_recording(path, given)
    return path


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Working folder with its own keys and emulated sensors.

    Central nodes compute small images in one process, so that none is dropped while they start.
    """
    for name, value in (("WORKERS", "1"), ("DIRECTIONS", "2d:9"), ("RANGE", "0.5:1.5")):
        monkeypatch.setenv(f"ERTIS_SERVE_{name}", value)
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))
    monkeypatch.setenv("ERTIS_KEYS_DIR", str(tmp_path / "keys"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(str(ROOT / folder) for folder in (".", "cli", "bench")))
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def emulators(place, words):
    """Sensors of the platform, emulated in this process."""
    (place / "emulated").mkdir()
    with contextlib.ExitStack() as stack:
        for name in SENSORS:
            stack.enter_context(Emulator([words], name=name, link=place / "emulated" / name))
        yield


@pytest.fixture
def ports():
    with reserved_address() as one, reserved_address() as other:
        yield {"5601": one.rpartition(":")[2], "5602": other.rpartition(":")[2]}


class Shell:
    """Run lines of a page; those that end with ``&`` run as processes until the test ends."""

    def __init__(self, place, ports, platform=None):
        self.place, self.ports, self.platform = place, ports, platform
        self.running, self.readers = [], []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in reversed(self.running):
            process.send_signal(signal.SIGTERM)
            process.wait(60)
        for process, reader in zip(self.running, self.readers, strict=True):
            reader.join(60)
            process.stdout.close()

    def run(self, line):
        for before, port in self.ports.items():
            line = line.replace(before, port)
        words = line.removesuffix("&").split()
        name = " ".join(words[: 1 + (words[0] == "sensors")])
        arguments = words[len(name.split()) :]
        if name == "serve" and "--listen" not in arguments:
            arguments += ["--listen", f"tcp://127.0.0.1:{self.ports['5601']}"]
            arguments += ["--publish", f"tcp://127.0.0.1:{self.ports['5602']}"]
        if name == "sensors emulate":
            arguments[0] = str(self.platform)
        if not line.endswith("&"):
            return run_here(self.place, shlex.join([*name.split(), *arguments]))
        command = [sys.executable, "-m", "ertis_cli", *name.split(), *arguments]
        as_json = [] if name == "sensors emulate" else ["--json"]
        process = subprocess.Popen([*command, *as_json], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.running.append(process)
        while READY[name] not in (reported := process.stdout.readline()):
            assert reported, line
        self.readers.append(threading.Thread(target=process.stdout.read, daemon=True))
        self.readers[-1].start()  # what nobody reads would stop it
        return reported


def lines_of(page, prompt):
    return re.findall(rf"^{prompt}\$\s+ertis (.*?)(?:\s+#.*)?$", page, re.MULTILINE)


def on_one_machine(text):
    return lines_of(next(block for block in text.split("```") if "$ ertis serve" in block), "")


def test_network_commands_of_the_tour_are_those_of_the_page():
    assert on_one_machine(TOUR) == on_one_machine(PAGE)


def test_network_page_on_one_machine_runs(place, ports, platform):
    lines = on_one_machine(PAGE)
    assert [line.split()[0] for line in lines] == ["example", "sensors", "serve", "capture", "listen", "sensors"]
    with Shell(place, ports, platform) as shell:
        *_, heard, status = [shell.run(line) for line in lines]
    assert len([line for line in heard.splitlines() if re.match(r"(front|left) ", line)]) == 10
    assert "front" in status
    assert "published at" in status
    recordings = list((place / "RECORDINGS").glob("*.h5"))
    assert {name for path in recordings for name in sensor_names(path)} == set(SENSORS)


@pytest.mark.alone
@pytest.mark.usefixtures("emulators")
def test_network_page_on_several_machines_runs(place, ports, monkeypatch):
    lines = lines_of(PAGE, "(?:central|sensor)")
    assert [line.split()[0] for line in lines] == ["keys", "keys", "keys", "serve", "capture"]
    # Two measurements of a sensor wait while the central node plans its images, and a third would drop the first.
    monkeypatch.setenv("ERTIS_CAPTURE_RATE", "0.2")
    with Shell(place, ports) as shell:
        for line in [*lines[:-1], f"{lines[-1]} --json"]:
            local = line.replace("HOST", "127.0.0.1").replace("0.0.0.0", "127.0.0.1")
            reported = shell.run(re.sub(r"(\w+\.public\.toml)", rf"{place}/keys/\1", local))
    events = [json.loads(line) for line in reported.splitlines()]
    acked = [each for each in events if each["event"] == "acked_through"]
    assert {each["sensor"]: each["acked_through"] for each in acked} == dict.fromkeys(SENSORS, 4)
    assert not any(each["dropped"] for each in acked)


@pytest.mark.usefixtures("emulators")
def test_network_page_on_one_machine_stores(place, ports):
    with Shell(place, ports) as shell:
        address = f"tcp://127.0.0.1:{ports['5601']}"
        shell.run(f"record --listen {address} -o RECORDINGS &")
        shell.run(f"capture --port front -n 3 --to {address}")
    (path,) = (place / "RECORDINGS").glob("*.h5")
    with open_recording(path) as recording:
        assert len(recording) == 3
