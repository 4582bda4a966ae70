"""What the README and the pages on simulation and sensors say runs."""

import contextlib
import importlib.metadata
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from ertis_cli.main import COMMANDS, cli

from ertis_numba.storage import open_recording

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SIMULATION = (ROOT / "docs" / "simulation.md").read_text()
DEVICES = (ROOT / "docs" / "devices.md").read_text()
NETWORK = next(block for block in README.split("```") if "ertis serve" in block)
PAGES = (
    "README.md",
    "docs/accuracy.md",
    "docs/beamformers.md",
    "docs/devices.md",
    "docs/formats.md",
    "docs/gallery.md",
    "docs/health.md",
    "docs/network.md",
    "docs/reliability.md",
    "docs/simulation.md",
)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with the files that the README's commands name."""
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))
    (tmp_path / "data").symlink_to(ROOT / "data")
    real = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
    shutil.copy(str(real), tmp_path / "RAW.bin")
    shutil.copy(ROOT / "data" / "synthetic" / "reflectors.toml", tmp_path / "SCENE.toml")
    return tmp_path


def environment(place):
    paths = os.pathsep.join(str(ROOT / folder) for folder in (".", "cli", "bench"))
    return os.environ | {"PYTHONPATH": paths, "MPLCONFIGDIR": str(place)}


def run(place, *command):
    return subprocess.run(command, cwd=place, env=environment(place), capture_output=True, text=True, check=True)


@contextlib.contextmanager
def in_background(place, command):
    """Run a command that ends with ``&`` until the block ends; it has told its ports when the block begins."""
    words = [sys.executable, "-m", "ertis_cli.main", *command.removesuffix("&").split()]
    with subprocess.Popen(words, cwd=place, env=environment(place), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline().startswith("/dev/")
        yield
        process.send_signal(signal.SIGTERM)
        process.communicate()


def test_python_lines(place):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    run(place, sys.executable, "-W", "error", "-c", code)
    assert (place / "image.png").stat().st_size > 10_000


def run_here(place, command):
    """Run a command in this process, which takes less to start."""
    with contextlib.chdir(place):
        done = CliRunner().invoke(cli, command.split())
    assert done.exit_code == 0, (command, done.stderr, done.exception)
    return done.stdout


def commands_in(page):
    return re.findall(r"^\$ ertis (.*?)(?:\s+#.*)?$", page, re.MULTILINE)


def test_commands(place):
    """Each in a process of its own where it is shown first."""
    started = set()
    with contextlib.ExitStack() as background:
        for command in commands_in(README.replace(NETWORK, "")):
            name, *arguments = command.split()
            if (place / "REC.h5").exists() and "REC.h5" in arguments and name in {"import", "simulate"}:
                (place / "REC.h5").unlink()  # each of the two ways to a recording is shown
            if arguments and arguments[-1] == "&":
                background.enter_context(in_background(place, command))
            elif name in started:
                run_here(place, command)
            else:
                run(place, sys.executable, "-m", "ertis_cli.main", name, *arguments)
            started.add(name)
    assert started == {*COMMANDS} - {"bench", "keys", "listen", "record", "serve", "status"}  # test_network_page.py
    assert (place / "picture.png").stat().st_size > 10_000
    assert (place / "shelf.png").stat().st_size > 10_000


def test_page_on_devices(place):
    with contextlib.ExitStack() as background:
        for command in commands_in(DEVICES):
            if command.endswith("&"):
                background.enter_context(in_background(place, command))
            else:
                run_here(place, command)
    with open_recording(place / "BOTH.h5", sensor="east") as recording:
        assert 10 <= len(recording) <= 20  # a busy emulator ignores pulses while it still measures


def test_example(place):
    """The nearest of the strong reflectors of the recording that is emulated."""
    with in_background(place, "emulate data/synthetic/reflectors.h5 &"):
        told = run(place, sys.executable, "-W", "error", str(ROOT / "examples" / "1_nearest_reflector.py"), "sensor")
    assert told.stdout.splitlines() == [f"#{number}: 1.15 m at -38°" for number in range(5)]


def test_page_on_simulation(place):
    (code,) = re.findall(r"```python\n(.*?)```", SIMULATION, re.DOTALL)
    told = run(place, sys.executable, "-W", "error", "-c", code).stdout
    assert "absorption True" in told
    assert told.endswith("() ()\n")  # nothing missed, nothing false
    for command in commands_in(SIMULATION):
        told = run_here(place, command)
    assert "points[0]" in told


def test_gallery_begins_as_the_readme():
    gallery = (ROOT / "docs" / "gallery.md").read_text()
    assert set(commands_in(gallery)) <= set(commands_in(README))


@pytest.mark.parametrize("page", PAGES)
def test_files_named_are_there(page):
    path = ROOT / page
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        assert "://" in target or (path.parent / target).exists(), target
