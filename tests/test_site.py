"""Help texts on the site: they are written for a terminal and rendered as pages."""

import runpy
from pathlib import Path

import click
import pytest
from ertis_cli.main import COMMANDS, cli

ROOT = Path(__file__).parents[1]


def helps(command):
    """Yield the help texts of a command, its options and its subcommands."""
    yield command.help or ""
    yield from (option.help or "" for option in command.params if isinstance(option, click.Option))
    for each in command.commands.values() if isinstance(command, click.Group) else ():
        yield from helps(each)


@pytest.mark.parametrize("name", COMMANDS)
def test_node_addresses_are_not_links(name):
    """Readers cannot open `tcp://` addresses."""
    core = pytest.importorskip("docutils.core", reason="docutils comes with what makes the site")
    nodes = pytest.importorskip("docutils.nodes")
    take_literally = runpy.run_path(str(ROOT / "docs" / "conf.py"))["_take_literally"]
    for text in helps(cli.get_command(click.Context(cli), name)):
        lines = text.replace("\b", "").splitlines()
        take_literally(None, None, lines)
        page = core.publish_doctree("\n".join(lines), settings_overrides={"report_level": 5})
        assert [each.astext() for each in page.findall(nodes.reference)] == []
        assert page.astext().count("tcp://") == text.count("tcp://")
