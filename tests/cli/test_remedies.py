"""Options that texts of the package name exist, in the command that prints them if it is known."""

import ast
from pathlib import Path

import pytest
from ertis_cli.main import COMMANDS

from tests.remedies import OPTION, every_option, options_of, strange_options

ROOT = Path(__file__).parents[2]
SOURCES = sorted(
    path for folder in ("cli/ertis_cli", "ertis_numba") for path in (ROOT / folder).rglob("*.py") if path.is_file()
)
OF_OTHERS = ("pip ", "docker ", "gunzip ", "bunzip2 ", "unxz ", "rosbags-convert ", "color-scheme")
OF_SYSTEMD = {"--now", "--reload", "--subsystem-match"}
"""Options of systemctl and udevadm."""
OF_PROCESSES = {"processes/child.py", "storage/sealing_process.py"}
"""Modules whose options are arguments of child processes."""


def texts(path):
    """Texts in a module, without the values of their fields."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.JoinedStr):
            yield "".join(each.value if isinstance(each, ast.Constant) else "{}" for each in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_options_in_texts_exist():
    known = every_option() | OF_SYSTEMD
    strange = {}
    for path in SOURCES:
        name = "/".join(path.parts[-2:])
        if name not in OF_PROCESSES:
            own = [text for text in texts(path) if not any(other in text for other in OF_OTHERS)]
            strange[name] = {option for text in own for option in OPTION.findall(text)} - known
    assert {name: options for name, options in strange.items() if options} == {}


@pytest.mark.parametrize("name", sorted({*COMMANDS} - {"demo"}))  # It starts other commands.
def test_messages_of_a_command_name_its_own_options(name):
    module = COMMANDS[name][0].partition(":")[0]
    shared = {each for each in COMMANDS if COMMANDS[each][0].startswith(f"{module}:")}
    path = ROOT / "cli" / f"{module.replace('.', '/')}.py"
    own = frozenset().union(*map(options_of, shared))
    for text in texts(path):
        if "\n" not in text and not any(name in text for name in OF_OTHERS):  # not a help text
            assert not strange_options(text, name) - own, text


@pytest.mark.parametrize(
    ("message", "strange"),
    [
        ("use --range, or run 'ertis export --top 3'", set()),
        ("use --top", {"--top"}),
        ("use --rnage", {"--rnage"}),
    ],
)
def test_strange_options_are_found(message, strange):
    assert strange_options(message, "process") == strange
