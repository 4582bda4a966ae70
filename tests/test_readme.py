"""What the README and the pages on simulation say runs."""

import contextlib
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from ertis_cli.main import COMMANDS, cli

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SIMULATION = (ROOT / "docs" / "simulation.md").read_text()
PAGES = (
    "README.md",
    "docs/accuracy.md",
    "docs/beamformers.md",
    "docs/formats.md",
    "docs/gallery.md",
    "docs/health.md",
    "docs/simulation.md",
)


@pytest.fixture
def place(tmp_path):
    """A folder with the files that the README's commands name."""
    (tmp_path / "data").symlink_to(ROOT / "data")
    real = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
    shutil.copy(str(real), tmp_path / "RAW.bin")
    shutil.copy(ROOT / "data" / "synthetic" / "reflectors.toml", tmp_path / "SCENE.toml")
    return tmp_path


def run(place, *command):
    paths = os.pathsep.join(str(ROOT / folder) for folder in (".", "cli", "bench"))
    environment = os.environ | {"PYTHONPATH": paths, "MPLCONFIGDIR": str(place)}
    return subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, check=True)


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
    for command in commands_in(README):
        name, *arguments = command.split()
        if (place / "REC.h5").exists() and "REC.h5" in arguments and name in {"import", "simulate"}:
            (place / "REC.h5").unlink()  # each of the two ways to a recording is shown
        if name in started:
            run_here(place, command)
        else:
            run(place, sys.executable, "-m", "ertis_cli.main", name, *arguments)
        started.add(name)
    assert started == {*COMMANDS} - {"bench"}
    assert (place / "picture.png").stat().st_size > 10_000
    assert (place / "shelf.png").stat().st_size > 10_000


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
