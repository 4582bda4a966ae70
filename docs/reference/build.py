"""Write the generated parts of the reference pages, so that they can be read in the repository: ``make reference``."""

import importlib
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import click
from click.testing import CliRunner
from ertis_cli._toml_reference import reference
from ertis_cli.main import cli

FOLDER = Path(__file__).parent
_BLOCK = re.compile(r"(<!-- (keys|names|commands) of (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def written(page: str) -> str:
    """Return the text of a page with its generated parts as they should be."""
    parts: dict[str, Callable[[str], Iterator[str]]] = {"keys": _keys, "names": _names, "commands": _commands}
    return _BLOCK.sub(lambda match: "\n".join([match[1], *parts[match[2]](match[3]), match[4]]), page)


def _keys(document: str) -> Iterator[str]:
    """Yield the keys of a kind of TOML file in a table for each section."""
    for section in reference(document):
        yield from (f"### {section.header or 'Top level'}".replace("[", "\\["), "", section.about, "")
        yield from ("| key | meaning | type | unit | default | example |", "| --- | --- | --- | --- | --- | --- |")
        for key in section.keys:
            code = (f"`{text}`" if text else "" for text in (key.default, key.example))
            yield _row(f"`{key.name}`", key.about, key.shape, key.unit, *code)
        yield ""


def _names(heading: str) -> Iterator[str]:
    """Yield a table of the public names that the next block of a page documents in full on the site."""
    page = (FOLDER / "python.md").read_text("utf-8").partition(f"<!-- names of {heading} -->")[2]
    block = re.search(r"```\{eval-rst\}\n(.*?)```", page, re.DOTALL)
    assert block is not None  # noqa: S101  a test reads every page
    yield from ("| name | purpose |", "| --- | --- |")
    for path in re.findall(r"^\.\. auto\w+:: ([\w.]+)", block[1], re.MULTILINE):
        yield _row(f"`{path.replace('ertis_numba.', 'ertis.', 1)}`", _summary(path))
    yield ""


def _summary(path: str) -> str:
    """Return the first sentence of the docstring of a name."""
    module, _, name = path.rpartition(".")
    value = getattr(importlib.import_module(module), name)
    return (inspect.getdoc(value) or "").partition("\n")[0]


def _commands(_: str) -> Iterator[str]:
    """Yield the help of each command."""
    with click.Context(cli) as ctx:
        for path in _paths(cli, ctx, ()):
            shown = CliRunner().invoke(
                cli, [*path, "--help"], prog_name="ertis", terminal_width=100, env={"COLUMNS": "100"}
            )
            yield from (f"{'##' if len(path) < 2 else '###'} ertis {' '.join(path)}".rstrip(), "")
            yield from ("```text", shown.stdout.rstrip(), "```", "")


def _paths(command: click.Command, ctx: click.Context, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    yield path
    if isinstance(command, click.Group):
        for name in command.list_commands(ctx):
            each = command.get_command(ctx, name)
            if each is not None and not each.hidden:
                yield from _paths(each, ctx, (*path, name))


def _row(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


if __name__ == "__main__":
    checking = sys.argv[1:] == ["--check"]
    for path in (FOLDER / name for name in ("settings.md", "commands.md", "python.md")):
        if (after := written(before := path.read_text("utf-8"))) == before:
            continue
        if not checking:
            path.write_text(after, "utf-8")
        sys.stdout.write(f"{path}: {'run make reference' if checking else 'updated'}\n")
