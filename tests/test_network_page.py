"""Network commands of the README and of docs/how-to/network.md, with other ports, hosts and sounds.

The emulated sensors of the platform repeat one measurement, because rendering the scene takes longer than all other
work together.
"""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ertis_numba.frames import Measurement, Stamp
from ertis_numba.simulation import Scene
from ertis_numba.storage import open_recording, sensor_names, write_recording
from tests.pages import page

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")
PAGE = page("network")
READY = {"emulate": "/dev/", "serve": '"listening"', "capture": '"kept"'}


@pytest.fixture(scope="session")
def platform(tmp_path_factory):
    """Recording with the sensors of the platform."""
    path = tmp_path_factory.mktemp("platform") / "platform.h5"
    with open_recording(ROOT / "data" / "synthetic" / "reflectors.h5") as recording:
        words = recording[0].data
    sensors = Scene.load(ROOT / "examples" / "platform.toml").sensors
    write_recording(path, [Measurement(words, each.settings(), Stamp(sensor=each.name)) for each in sensors])
    return path


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Working folder with its own keys and emulated sensors, and two free ports."""
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))
    monkeypatch.setenv("ERTIS_KEYS_DIR", str(tmp_path / "keys"))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(str(ROOT / folder) for folder in (".", "cli", "bench")))
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def ports():
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(2)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        found = [str(each.getsockname()[1]) for each in sockets]
    return dict(zip(("5601", "5602"), found, strict=True))


class Shell:
    """Run lines of a page; those that end with ``&`` run until the test ends."""

    def __init__(self, ports, platform):
        self.ports, self.platform = ports, platform
        self.running, self.readers = [], []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in reversed(self.running):
            process.send_signal(signal.SIGTERM)
            process.wait(30)
        for process, reader in zip(self.running, self.readers, strict=True):
            reader.join(30)
            process.stdout.close()

    def run(self, line):
        for before, port in self.ports.items():
            line = line.replace(before, port)
        name, *arguments = line.removesuffix("&").split()
        if name == "serve" and "--listen" not in arguments:
            arguments += ["--listen", f"tcp://127.0.0.1:{self.ports['5601']}"]
            arguments += ["--publish", f"tcp://127.0.0.1:{self.ports['5602']}"]
        if name == "emulate":
            arguments[0] = str(self.platform)
        command = [sys.executable, "-m", "ertis_cli", name, *arguments]
        if not line.endswith("&"):
            done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
            assert done.returncode == 0, (line, done.stderr)
            return done.stdout
        as_json = [] if name == "emulate" else ["--json"]
        process = subprocess.Popen([*command, *as_json], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.running.append(process)
        while READY[name] not in (reported := process.stdout.readline()):
            assert reported, line
        self.readers.append(threading.Thread(target=process.stdout.read, daemon=True))
        self.readers[-1].start()  # what nobody reads would stop it
        return reported


def lines_of(page, prompt):
    return re.findall(rf"^{prompt}\$\s+ertis (.*?)(?:\s+#.*)?$", page, re.MULTILINE)


@pytest.mark.parametrize(
    "block",
    [next(block for block in page.split("```") if "$ ertis serve" in block) for page in (README, PAGE)],
    ids=["readme", "page"],
)
def test_network_page_on_one_machine_runs(place, ports, platform, block):
    lines = lines_of(block, "")
    assert [line.split()[0] for line in lines] == ["example", "emulate", "serve", "capture", "listen", "status"]
    with Shell(ports, platform) as shell:
        *_, heard, status = [shell.run(line) for line in lines]
    assert len([line for line in heard.splitlines() if re.match(r"(front|left) ", line)]) == 10
    assert "front" in status
    assert "published at" in status
    recordings = list((place / "RECORDINGS").glob("*.h5"))
    assert {name for path in recordings for name in sensor_names(path)} == {"front", "left"}


def test_network_page_on_several_machines_runs(place, ports, platform):
    lines = lines_of(PAGE, "(?:central|sensor)")
    assert [line.split()[0] for line in lines] == ["keys", "keys", "keys", "serve", "capture"]
    with Shell(ports, platform) as shell:
        shell.run("emulate examples/platform.toml &")
        for line in [*lines[:-1], f"{lines[-1]} --json"]:
            local = line.replace("HOST", "127.0.0.1").replace("0.0.0.0", "127.0.0.1")
            reported = shell.run(re.sub(r"(\w+\.public\.toml)", rf"{place}/keys/\1", local))
    events = [json.loads(line) for line in reported.splitlines()]
    acked = [each for each in events if each["event"] == "acked_through"]
    assert {each["sensor"]: each["acked_through"] for each in acked} == {"front": 4, "left": 4}
    assert not any(each["dropped"] for each in acked)


def test_network_page_on_one_machine_stores(place, ports, platform):
    with Shell(ports, platform) as shell:
        address = f"tcp://127.0.0.1:{ports['5601']}"
        shell.run("emulate examples/platform.toml &")
        READY["record"] = '"listening"'
        shell.run(f"record --listen {address} -o RECORDINGS &")
        shell.run(f"capture --port front -n 3 --to {address}")
    (path,) = (place / "RECORDINGS").glob("*.h5")
    with open_recording(path) as recording:
        assert len(recording) == 3
