"""The page on the first hour runs in a folder outside the source; the commands of all pages parse."""

import contextlib
import json
import re
import shlex

import click
import pytest
from ertis_cli.main import cli

from tests.pages import GUIDE, ROOT, commands_in, in_background, page, run_here

PAGES = [ROOT / "README.md", *GUIDE]


def commands(text):
    """Lines that begin with a prompt, without prompt, variables and redirections."""
    for line in re.findall(r"^\w*\$ (?:[A-Z_]+=\S+ )*ertis (.*?)(?:\s+#.*)?$", text, re.MULTILINE):
        yield line.partition(" | ")[0].partition(" > ")[0].removesuffix("&").strip()


def found(words):
    """The command that the words name, and the remaining words."""
    command, rest = cli, words[2:] if words[0] == "--config" else list(words)
    while isinstance(command, click.Group) and rest:
        name = rest.pop(0)
        following = command.get_command(click.Context(command), name)
        assert following is not None, words
        command = following
    return command, rest


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_command_lines_of_pages_parse(path):
    """They are not run."""
    for line in commands(path.read_text("utf-8")):
        command, rest = found(shlex.split(line))
        command.make_context(line, rest)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_options_named_on_pages_exist(path):
    """This includes options in the prose."""
    for text in re.findall(r"`ertis ([^`]+)`", path.read_text("utf-8")):
        if not re.match(r"[a-z]", text):
            continue  # as ertis --help, and ertis COMMAND --help
        command, words = found(text.split())
        known = {option for each in command.params for option in (*each.opts, *each.secondary_opts)} | {"--help"}
        assert {word.partition("=")[0] for word in words if re.fullmatch(r"--?[a-z][\w-]*", word)} <= known, text


def test_commands_of_pages_need_no_source_file():
    for path in PAGES:
        for line in commands(path.read_text("utf-8")):
            assert "data/synthetic" not in line, (path.name, line)
            assert "examples/" not in line, (path.name, line)


def test_first_hour_page_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))
    """The emulator replays the recording of its scene, which starts sooner."""
    text = page("first-hour").replace(
        "$ ertis sensors emulate reflectors.toml", "$ ertis sensors emulate reflectors.h5"
    )
    assert "$ ertis sensors emulate reflectors.h5" in text
    steps = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    assert all(len(step.splitlines()) <= 3 for step in steps)
    for name, content in re.findall(r"`([\w.]+)`:\n\n```\w+\n(.*?)```", text, re.DOTALL):
        (tmp_path / name).write_text(content)
    with contextlib.ExitStack() as background:
        for command in commands_in(text):
            if command.endswith("&"):
                background.enter_context(in_background(tmp_path, command))
            elif command != "doctor":  # test_doctor
                run_here(tmp_path, command)
    for name in ("reflectors.png", "mine.png", "live.html", "points.csv"):
        assert (tmp_path / name).stat().st_size > 1000, name
    for name in ("mine", "posts"):
        (peak, *_) = map(json.loads, run_here(tmp_path, f"peaks {name}.energy.h5 --top 1 --json").splitlines())
        assert "14." in json.dumps(peak), peak  # the nearer post, 14 degrees to the left
