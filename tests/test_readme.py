"""What the README says runs."""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


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


def test_commands(place):
    commands = re.findall(r"^\$ ertis (.*?)(?:\s+#.*)?$", README, re.MULTILINE)
    assert len(commands) >= 6
    for command in commands:
        arguments = command.split()
        if (place / "REC.h5").exists() and "REC.h5" in arguments and arguments[0] in {"import", "simulate"}:
            (place / "REC.h5").unlink()  # each of the two ways to a recording is shown
        run(place, sys.executable, "-m", "ertis_cli.main", *arguments)
    assert (place / "picture.png").stat().st_size > 10_000


def test_files_named_are_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert "://" in target or (ROOT / target).exists(), target
