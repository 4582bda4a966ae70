"""Commands in odd surroundings: every encoding of the output, closed streams, backends, and variables of Numba."""

import codecs
import encodings.aliases
import errno
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import click
import numba
import pytest
from ertis_cli import _output

from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels import _numba_setup
from ertis_numba.kernels._cpu import loading

RECORDING = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
ENCODINGS = sorted(
    name
    for name in {*encodings.aliases.aliases.values(), "utf_8_sig"} - {"mbcs", "oem"}
    if codecs.lookup(name)._is_text_encoding  # noqa: SLF001  Python has no public name for it
)
READABLE = {
    "µ": "u",
    "°": " deg",
    "−": "-",
    "–": "-",
    "×": "x",
    "…": "...",
    "✓": "ok",
    "½": "1/2",
    "⁻": "-",
    "³": "3",
    "é": "e",
    "σ": "sigma",
    "→": "->",
    "≥": ">=",
    "\N{SNOWMAN}": "?",
    "漢": "?",
}
TIMEOUT_S = 200


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_encoding_of_python_prints_readable_text(encoding, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    _output.replace_unencodable()
    stream.write("\n".join(READABLE))
    stream.flush()
    shown = stream.buffer.getvalue().decode(encoding).split("\n")
    for char, line in zip(READABLE, shown, strict=True):
        assert line in {READABLE[char], char, char.encode(encoding, "replace").decode(encoding)}


@pytest.mark.parametrize("errors", ["replace", "xmlcharrefreplace"])
def test_error_handler_of_the_user_remains(errors, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="cp932", errors=errors)
    monkeypatch.setattr(sys, "stdout", stream)
    _output.replace_unencodable()
    assert stream.errors == errors


def test_bytes_of_file_names_are_printed_unchanged(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="cp1252", errors="surrogateescape")
    monkeypatch.setattr(sys, "stdout", stream)
    _output.replace_unencodable()
    stream.write("a\udcff")
    stream.flush()
    assert stream.buffer.getvalue() == b"a\xff"


def run(*words, redirect="", **environment):
    """Run a command in a shell, and return its exit code, stdout and stderr."""
    command = f'exec "{sys.executable}" -m ertis_cli "$@" {redirect}'
    return subprocess.run(
        ["sh", "-c", command, "sh", *map(str, words)],
        env=os.environ | environment,
        capture_output=True,
        timeout=TIMEOUT_S,
        check=False,
    )


SHELL = pytest.mark.skipif(sys.platform == "win32", reason="the test needs a POSIX shell")


@SHELL
@pytest.mark.parametrize("encoding", ["cp932", "gbk", "koi8_r", "utf_16"])
def test_command_prints_in_an_encoding_without_its_characters(encoding):
    done = run("sensors", "check", "--help", PYTHONIOENCODING=encoding)
    assert (done.returncode, done.stderr) == (0, b"")
    assert "Usage: " in done.stdout.decode(encoding)


@SHELL
@pytest.mark.parametrize("redirect", [">&-", "2>&-", "<&-", ">&- 2>&- <&-"])
def test_command_works_with_closed_streams(redirect):
    done = run("info", RECORDING, redirect=redirect)
    assert (done.returncode, done.stderr) == (0, b"")


@SHELL
@pytest.mark.parametrize("backend", ["module://matplotlib_inline.backend_inline", "nonsense", "qtagg"])
def test_plot_ignores_the_backend_of_a_notebook(backend, tmp_path):
    done = run("plot", "eRTIS_v3D1", "--kind", "array", "-o", tmp_path / "a.png", MPLBACKEND=backend)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_scripts_get_the_backend_back(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setattr(_output, "_BACKEND", "svg")
    _output.draw_without_display()
    assert os.environ["MPLBACKEND"] == "agg"
    _output.restore_display()
    assert os.environ["MPLBACKEND"] == "svg"
    monkeypatch.setattr(_output, "_BACKEND", None)
    _output.restore_display()
    assert "MPLBACKEND" not in os.environ


REFUSED = {
    "NUMBA_NUM_THREADS=0": "Numba refuses one of its environment variables.*NUMBA_NUM_THREADS=0",
    "NUMBA_NUM_THREADS=many": "NUMBA_NUM_THREADS=many .* could not be parsed",
    "NUMBA_THREADING_LAYER=fast": "NUMBA_THREADING_LAYER is 'fast'; use one of default,",
    "NUMBA_THREADING_LAYER_PRIORITY=omp": "must list tbb, omp and workqueue in any order; unset it",
    "NUMBA_DISABLE_JIT=1": "NUMBA_DISABLE_JIT is set",
}
LOAD = """
from ertis_numba import kernels
try:
    kernels.load("cpu")
except kernels._dispatch.DeviceError as error:
    print(error)
"""


@pytest.mark.parametrize("variable", REFUSED)
def test_variable_of_numba_is_named_if_it_prevents_processing(variable):
    name, _, value = variable.partition("=")
    done = subprocess.run(
        [sys.executable, "-c", LOAD], env=os.environ | {name: value}, capture_output=True, text=True, check=True
    )
    assert re.search(REFUSED[variable], done.stdout), done.stdout


def test_missing_library_of_a_threading_layer_is_named(monkeypatch):
    monkeypatch.setattr("numba.config.THREADING_LAYER", "tbb")
    monkeypatch.setitem(sys.modules, "numba.np.ufunc.tbbpool", None)
    with pytest.raises(DeviceError, match=r"NUMBA_THREADING_LAYER is 'tbb', but its library is missing .*; unset it"):
        _numba_setup.prepare()


def test_kernels_are_cached_in_a_private_folder_without_a_writable_one(monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(_numba_setup, "_cache_folder", lambda _: None)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr("numba.config.reload_config", lambda: None)
    _numba_setup.prepare()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o077 == 0
    assert "set NUMBA_CACHE_DIR to a writable folder" in caplog.text
    folder.chmod(0o777)  # Another user may have put code into it.
    assert _numba_setup._private_folder() != folder  # noqa: SLF001


def test_unwritable_cache_folder_of_the_user_is_named(monkeypatch, caplog, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "file" / "kernels"))
    _numba_setup.prepare()
    (logged,) = caplog.messages
    assert re.search(
        r"NUMBA_CACHE_DIR, .*file/kernels, is not writable; compiled kernels are stored in .*__pyc", logged
    )


def test_kernels_cached_with_types_that_no_longer_exist_are_compiled_again(monkeypatch, tmp_path):
    """A later version of a module has renamed a type; Numba's index of the first version names it."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    program = (
        "import grown\n"
        "from ertis_numba.kernels._cpu.loading import load_without_compiler\n"
        "load_without_compiler([grown.first])\n"
        "print(grown.first(grown.{0}(1)))\n"
    )
    for name in ("Former", "New", "New"):  # of two lengths, since Python compares size and second of its compiled files
        (tmp_path / "grown.py").write_text(
            "from typing import NamedTuple\nfrom numba import njit\n"
            f"class {name}(NamedTuple):\n    x: int\n"
            "@njit(cache=True)\ndef first(p):\n    return p[0] + 1\n"
        )
        done = subprocess.run([sys.executable, "-c", program.format(name)], capture_output=True, text=True, check=True)
        assert done.stdout == "2\n"


def test_kernels_run_without_space_for_their_cache(monkeypatch, caplog):
    def save(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    @numba.njit(cache=True)
    def doubled(value):
        return 2 * value

    monkeypatch.setattr(doubled._cache, "_save_overload", save)  # noqa: SLF001
    loading.load_without_compiler([doubled])
    assert (doubled(2), doubled(2.5)) == (4, 5.0)
    (logged,) = caplog.messages
    assert re.search(r"cannot be stored in .* \(No space left on device\), .*set NUMBA_CACHE_DIR to a folder", logged)


NAMES = {
    "rec\n.h5": r"rec\n.h5: done rec\n.energy.h5",
    "a\nb/rec.h5": r"a\nb/rec.h5: done rec.energy.h5",
    "--output=a\x07\u2028b.h5": r"a\x07\u2028b.h5: done a\x07\u2028b.energy.h5",
    "\n": "\n: done \n.energy.h5",
}


@pytest.mark.parametrize("argument", NAMES)
def test_names_with_line_breaks_are_printed_in_one_line(argument, monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    monkeypatch.setattr(_output, "_ESCAPED", {})
    _output.escape_names(["process", argument, "--force"])
    path = Path(argument.rpartition("=")[2])
    click.echo(f"{path}: done {path.stem}.energy.h5\nnext")
    assert stream.getvalue() == f"{NAMES[argument]}\nnext\n"


def test_error_with_a_line_break_in_a_name_has_one_line(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "ertis_cli", "info", "a\n  b.h5"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith(r"ertis: error: a\n  b.h5: No such file")


def test_missing_temporary_folder_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(_numba_setup, "_cache_folder", lambda _: None)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    with pytest.raises(DeviceError, match=r"no folder for compiled kernels is writable .*; set NUMBA_CACHE_DIR to a"):
        _numba_setup.prepare()


def test_codec_that_cannot_encode_lines_is_replaced(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="idna")
    monkeypatch.setattr(sys, "stdout", stream)
    _output.replace_unencodable()
    stream.write("µ" * 80 + "\n")
    stream.flush()
    assert stream.buffer.getvalue().decode() == "µ" * 80 + "\n"
