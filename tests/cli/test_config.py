"""Precedence of options: command line, environment variables, configuration file, defaults."""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from tests.pages import path_of

ROOT = Path(__file__).parents[2]
REFLECTORS = ROOT / "data" / "synthetic" / "reflectors.h5"


def ertis(*arguments, folder, **variables):
    """Run a command in this process, in a folder, with no other variables of ertis than these."""
    unset = dict.fromkeys(name for name in os.environ if name.startswith("ERTIS_"))
    with contextlib.chdir(folder):
        return CliRunner().invoke(cli, [str(each) for each in arguments], env=unset | variables)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """An energyscape file with few directions, in a folder with a configuration file."""
    folder = tmp_path_factory.mktemp("config")
    (folder / "ertis.toml").write_text('[process]\ndirections = "2d:31"\nrange = "0.5:4"\nquiet = true\n')
    done = ertis("--config", "ertis.toml", "process", REFLECTORS, "-o", "img.h5", "--json", folder=folder)
    assert (done.exit_code, done.stderr) == (0, "")
    return folder, json.loads(done.stdout)


def test_config_file_sets_options(images):
    assert images[1]["directions"] == 31


def test_options_override_variables_and_variables_override_files(images):
    folder, _ = images
    (folder / "peaks.toml").write_text("[peaks]\ntop = 1\n")

    def number(*options, **variables):
        done = ertis(*options, folder=folder, **variables)
        assert done.exit_code == 0, done.stderr
        return len(json.loads(done.stdout)["peaks"])

    plain = number("peaks", "img.h5", "--json")
    assert plain > 3
    assert number("--config", "peaks.toml", "peaks", "img.h5", "--json") == 1
    assert number("peaks", "img.h5", "--json", ERTIS_CONFIG="peaks.toml") == 1
    assert number("--config", "peaks.toml", "peaks", "img.h5", "--json", ERTIS_PEAKS_TOP="2") == 2
    given = ("--config", "peaks.toml", "peaks", "img.h5", "--json", "--top", "3")
    assert number(*given, ERTIS_PEAKS_TOP="2") == 3


def test_shared_variable_applies_to_commands_with_that_option(images):
    folder, _ = images
    done = ertis("info", "img.h5", folder=folder, ERTIS_THREADS="x")
    assert done.exit_code == 0  # info has no option --threads
    done = ertis("process", REFLECTORS, "-o", "b.h5", folder=folder, ERTIS_THREADS="x")
    assert done.exit_code == 2
    assert "'x' is not a valid integer (from the variable ERTIS_THREADS); see 'ertis process --help'" in done.stderr
    done = ertis("process", REFLECTORS, "-o", "b.h5", folder=folder, ERTIS_THREADS="1", ERTIS_PROCESS_THREADS="y")
    assert "'y' is not a valid integer (from the variable ERTIS_PROCESS_THREADS)" in done.stderr


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("ERTIS_PROCESS_DIRECTION", "did you mean 'ERTIS_PROCESS_DIRECTIONS'?"),
        ("ERTIS_PROCES_DIRECTIONS", "did you mean 'ERTIS_PROCESS_DIRECTIONS'?"),
        ("ERTIS_THREAD", "did you mean 'ERTIS_THREADS'?"),
        ("ERTIS_CACHEDIR", "did you mean 'ERTIS_CACHE_DIR'?"),
        ("ERTIS_KEYS_NEW_DIRR", "did you mean 'ERTIS_KEYS_NEW_DIR'?"),
        ("ERTIS_PORT_5601_TCP", "unset it if no other program needs it"),  # possibly a variable of another program
    ],
)
def test_unknown_ertis_variable_causes_one_warning(images, name, meant):
    """The command continues, because other programs may use such a name."""
    folder, _ = images
    done = ertis("info", "img.h5", "--json", folder=folder, **{name: "3"})
    assert done.exit_code == 0
    assert json.loads(done.stdout)
    assert done.stderr == f"ertis: warning: no command reads the variable {name}; {meant}\n"


def test_variables_that_are_not_options_cause_no_warning(images):
    folder, _ = images
    path = str(folder)
    of_folders = dict.fromkeys(("ERTIS_CACHE_DIR", "ERTIS_EMULATED_DIR", "ERTIS_KEYS_DIR", "ERTIS_TRACE"), path)
    given = {
        "ERTIS_PROCESS_MAX_ERROR": "-40",
        "ERTIS_SERVE_ALLOW": "x",
        "ERTIS_IMPORT_POSES_OFFSET_S": "1",
        "ERTIS_KEYS_NEW_DIR": path,
        "ERTIS_THREADS": "1",
    }
    done = ertis("info", "img.h5", folder=folder, **of_folders, **given, ERTIS_BENCH_MARK="1")
    assert (done.exit_code, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("proces a.h5", "No such command 'proces' (did you mean 'process'?); see 'ertis --help'"),
        ("devices", "No such command 'devices' (did you mean 'sensors list'?)"),
        ("import-poses a.h5 b.tum", "No such command 'import-poses' (did you mean 'import poses'?)"),
        ("xyz", "No such command 'xyz' (choose one of acoustic, bench, capture, compare, "),
    ],
)
def test_unknown_command_suggests_known_ones(tmp_path, line, message):
    done = ertis(*line.split(), folder=tmp_path)
    assert done.exit_code == 2
    assert done.stderr.startswith(f"ertis: error: {message}")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[proces]\n", "'proces' is not a command; did you mean 'process'?"),
        ("[process]\nmax_errors = 1\n", "process has no option 'max_errors'; did you mean 'max-error'?"),
        ("[keys.new]\nfoo = 1\n", "keys new has no option 'foo'; choose one of "),
        ("process = 3\n", "process is 3; write a table of options, as in [process]"),
        ("[process]\nthreads = 'x'\n", "'x' is not a valid integer (from ertis.toml)"),
        ("[process\n", "choose a readable TOML file (--config)"),
    ],
    ids=["command", "option", "of a group", "no table", "value", "no TOML"],
)
def test_invalid_config_file_is_refused_in_one_line(tmp_path, text, message):
    (tmp_path / "ertis.toml").write_text(text)
    done = ertis("--config", "ertis.toml", "process", REFLECTORS, "-o", "a.h5", folder=tmp_path)
    assert done.exit_code in {1, 2}
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == [tmp_path / "ertis.toml"]


def test_missing_config_file_is_reported(tmp_path):
    done = ertis("--config", "none.toml", "info", REFLECTORS, folder=tmp_path)
    assert (done.exit_code, done.stderr) == (
        1,
        "ertis: error: none.toml: No such file or directory; choose a readable TOML file (--config)\n",
    )


def test_help_and_completion_work_without_config_file(tmp_path):
    """Every new shell requests completions, and users need help most when something is broken."""
    for line in ("--help", "reference completion bash"):
        done = ertis(*line.split(), folder=tmp_path, ERTIS_CONFIG="none.toml")
        assert done.exit_code == 0, line
        assert len(done.stdout.splitlines()) > 10
        warned = (
            done.stderr
            == "ertis: warning: none.toml: No such file or directory; choose a readable TOML file (--config)\n"
        )
        assert warned == (line != "--help")


def test_inapplicable_option_is_refused_only_if_typed(images, tmp_path):
    folder, _ = images
    text = "[process]\nworkers = 2\n[export]\ntop = 5\ntopic = ['points']\n[import.signals]\nskip = 0.1\n"
    (tmp_path / "mine.toml").write_text(text)
    raw = tmp_path / "a.bin"
    raw.write_bytes(bytes(4 * 65_536))
    for given, typed, message in (
        (
            ("process", REFLECTORS, "-o", "p.h5", "--directions", "2d:5"),
            ("--workers", 2),
            "applies to several recordings",
        ),
        (("export", folder / "img.h5", "-o", "a.npz"), ("--top", 5), "option --top is given, but format 'npz'"),
        (
            ("export", folder / "img.h5", "-o", "a.csv"),
            ("--topic", "points"),
            "option --topic is given, but format 'csv'",
        ),
        (
            ("import", "signals", raw, "--layout", "eRTIS_v3D1", "--preset", "short_25_50"),
            ("--skip", 1),
            "is for PCM (.wav, .h5)",
        ),
    ):
        done = ertis(*given, *typed, folder=tmp_path)
        assert done.exit_code != 0
        assert message in done.stderr
        done = ertis("--config", "mine.toml", *given, folder=tmp_path)
        assert done.exit_code == 0, done.stderr


def test_command_line_page_runs(tmp_path):
    """The test runs the file and the commands of the page verbatim."""
    page = path_of("command-line").read_text("utf-8")
    (tmp_path / "ertis.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    (tmp_path / "reflectors.h5").symlink_to(ROOT / "data" / "synthetic" / "reflectors.h5")
    counts = []
    for variables, line in re.findall(r"^\$ ((?:\w+=\S+ )?)ertis (--config.*)$", page, re.MULTILINE):
        given = dict(each.split("=") for each in variables.split())
        done = ertis(*line.split(), "--json", folder=tmp_path, **given)
        assert done.exit_code == 0, done.stderr
        counts.append(json.loads(done.stdout)["directions"])
    assert counts == [3000, 90]
    assert "Numba's" in ertis("doctor", folder=tmp_path).stdout


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("ertis proc", "process"),
        ("ertis process --max", "--max-error"),
        ("ertis keys n", "new"),
        ("ertis import signals --preset def", "default_25_50"),
        ("ertis capture --layout uRT", "uRTIS_v1"),
    ],
)
def test_bash_completes_commands_options_and_values(tmp_path, line, wanted):
    """A real bash evaluates the completion script."""
    words = " ".join(f"'{word}'" for word in line.split())
    command = tmp_path / "ertis"
    command.write_text(f"#!/bin/sh\nexec '{sys.executable}' -m ertis_cli \"$@\"\n")
    command.chmod(0o755)
    script = (
        'eval "$(ertis reference completion bash)"\n'
        f"COMP_WORDS=({words}); COMP_CWORD={len(line.split()) - 1}\n"
        "_ertis_completion ertis; printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    variables = {
        "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(str(ROOT / each) for each in (".", "cli", "bench")),
    }
    done = subprocess.run(
        ["bash", "-c", script],
        cwd=tmp_path,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert wanted in done.stdout.split(), done.stderr


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_for_each_shell(tmp_path, shell):
    done = ertis("reference", "completion", shell, folder=tmp_path)
    assert done.exit_code == 0
    assert "_ERTIS_COMPLETE" in done.stdout


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_completion_works_after_lines_of_the_page(tmp_path):
    (before,) = re.findall(r"in ~/.zshrc, after: (.*)", path_of("command-line").read_text("utf-8"))
    printed = tmp_path / "printed"
    printed.write_text(ertis("reference", "completion", "zsh", folder=tmp_path).stdout)
    done = subprocess.run(
        # -u suppresses questions about the owner of the zsh folders.
        ["zsh", "-f", "-c", f'{before} -u; eval "$(<{printed})"; print ${{_comps[ertis]}}'],
        cwd=tmp_path,
        env=os.environ | {"HOME": str(tmp_path)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.stdout.split(), done.stderr) == (["_ertis_completion"], "")
    assert before in " ".join(ertis("reference", "completion", "--help", folder=tmp_path).stdout.split())
