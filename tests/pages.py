"""Tools that run the commands and code of documentation pages."""

import contextlib
import io
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from typing import NamedTuple

from click.testing import CliRunner
from ertis_cli.main import cli

__all__ = [
    "DOCS",
    "GUIDE",
    "ROOT",
    "Forked",
    "command_program",
    "commands_in",
    "environment",
    "forking",
    "in_background",
    "page",
    "path_of",
    "python_in",
    "run",
    "run_code_here",
    "run_here",
]

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
GUIDE = sorted(path for path in DOCS.rglob("*.md") if path.parent.name not in {"decisions", "upstream"})
"""Paths of all pages of the guide; page names are unique across its folders."""


def path_of(name):
    """Return the path of a page of the guide, given its name without the folder."""
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
    """Run a command that ends with ``&`` until the block ends; wait for its port names first."""
    words = [sys.executable, "-m", "ertis_cli.main", *command.removesuffix("&").split()]
    with subprocess.Popen(words, cwd=place, env=environment(place), stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline().startswith("/dev/")
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            process.communicate()


def run_here(place, command):
    """Run a command in this process, which is faster than starting one."""
    with contextlib.chdir(place):
        done = CliRunner().invoke(cli, shlex.split(command))
    assert done.exit_code == 0, (command, done.stderr, done.exception)
    return done.stdout


def run_code_here(place, code, name="page"):
    """Run the Python code of a page in this process, with warnings as errors, and return what it prints.

    The code has a module of its own, and its figures are closed afterwards.
    """
    printed = io.StringIO()
    with contextlib.chdir(place), contextlib.redirect_stdout(printed), warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            exec(compile(code, name, "exec"), {"__name__": "__main__"})
        finally:
            if "matplotlib.pyplot" in sys.modules:
                sys.modules["matplotlib.pyplot"].close("all")
    return printed.getvalue()


class Forked(NamedTuple):
    """Exit code and output of a program."""

    code: int
    stdout: str
    stderr: str


_FORKING = """
import gc, importlib, json, os, sys

preload, unloaded, folder = json.loads(sys.stdin.readline())
for name in preload:
    importlib.import_module(name)
if "numba" in preload:
    sys.modules["numba"].njit(lambda: 0)()  # loads what each compiled function needs
loaded = {name.partition(".")[0] for name in sys.modules}
assert loaded.isdisjoint(unloaded), sorted(loaded.intersection(unloaded))
gc.freeze()  # the last collection of each program would scan and copy all of it
for program in iter(sys.stdin.readline, ""):
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for descriptor, end in ((1, "out"), (2, "err")):
            os.dup2(os.open(f"{folder}/{end}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), descriptor)
        exec(compile(json.loads(program), "<program>", "exec"), {"__name__": "__main__"})
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@contextlib.contextmanager
def forking(
    place, output, preload=("numpy", "scipy.fft", "scipy.spatial", "numba", "h5py", "click", "msgspec"), unloaded=()
):
    """Yield a function that runs a Python program in a fork of one interpreter and returns a `Forked`.

    That interpreter has imported only the libraries named in ``preload``, and none of ``unloaded``. Each program
    imports the modules of this project itself, as in a process of its own, but takes a third of the processor time.
    The function writes files to the folder ``output``.
    """
    with subprocess.Popen(
        [sys.executable, "-W", "error", "-c", _FORKING],
        cwd=place,
        env=environment(place) | {"OPENBLAS_NUM_THREADS": "1"},  # a process with threads should not fork
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:

        def run_forked(program):
            print(json.dumps(program), file=process.stdin, flush=True)
            code = int(process.stdout.readline())
            return Forked(code, *((output / end).read_text("utf-8") for end in ("out", "err")))

        unloaded = [*unloaded, "ertis_numba", "ertis_cli", "ertis_bench"]
        print(json.dumps([list(preload), unloaded, str(output.absolute())]), file=process.stdin, flush=True)
        yield run_forked
    assert process.returncode == 0


def command_program(words):
    """Return the Python program of a command, given its words after ``ertis``."""
    return f"import sys; sys.argv[1:] = {[*map(str, words)]!r}\nfrom ertis_cli.__main__ import main; main()"


def commands_in(text):
    return re.findall(r"^\$ ertis (.*?)(?:\s+#.*)?$", text, re.MULTILINE)


def python_in(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)
