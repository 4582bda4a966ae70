"""Running what pages say."""

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

from click.testing import CliRunner
from ertis_cli.main import cli

__all__ = [
    "DOCS",
    "GUIDE",
    "ROOT",
    "commands_in",
    "environment",
    "in_background",
    "page",
    "path_of",
    "python_in",
    "run",
    "run_here",
]

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
GUIDE = sorted(path for path in DOCS.rglob("*.md") if path.parent.name not in {"decisions", "upstream"})
"""Pages of the guide, in all of its folders; their names are unique."""


def path_of(name):
    """Return the path of a page of the guide, whose folder the name leaves out."""
    (path,) = (each for each in GUIDE if each.stem == name)
    return path


def page(name):
    return path_of(name).read_text("utf-8")


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
        try:
            assert process.stdout.readline().startswith("/dev/")
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            process.communicate()


def run_here(place, command):
    """Run a command in this process, which takes less to start."""
    with contextlib.chdir(place):
        done = CliRunner().invoke(cli, shlex.split(command))
    assert done.exit_code == 0, (command, done.stderr, done.exception)
    return done.stdout


def commands_in(text):
    return re.findall(r"^\$ ertis (.*?)(?:\s+#.*)?$", text, re.MULTILINE)


def python_in(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)
