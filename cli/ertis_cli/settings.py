"""``ertis reference settings``: keys of TOML files."""

import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_cli._toml_reference import TableReference

__all__ = ["settings"]

_WIDTH = 100


@click.command()
@click.argument(
    "document", type=click.Choice(["settings", "scene", "layout", "mounting"]), default="settings", metavar="[KIND]"
)
@options.as_json
def settings(*, document: str, as_json: bool) -> None:
    """Print every key of a settings, scene, layout or mounting file.

    KIND is settings (the default), scene, layout or mounting. The output is a template: save it, and remove the # from
    the keys to set. The template states the meaning, type, unit and default of each key, with an example.
    """
    from ertis_cli._toml_reference import reference

    sections = reference(document)
    if as_json:
        options.print_json({"document": document, "tables": [asdict(section) for section in sections]})
        return
    click.echo("\n".join(line for section in sections for line in _lines(section)))


def _lines(section: "TableReference") -> Iterator[str]:
    """Yield the lines of a table; all but its header are comments."""
    yield from textwrap.wrap(section.about, _WIDTH, initial_indent="# ", subsequent_indent="# ")
    if section.header:
        yield f"# {section.header}"
    for key in section.keys:
        yield "#"
        unit = f", {key.unit}" if key.unit else ""
        about = f"{key.about} ({key.shape}{unit}; default: {key.default})"
        yield from textwrap.wrap(about, _WIDTH, initial_indent="#   ", subsequent_indent="#   ")
        yield f"# {key.example}"
    yield ""
