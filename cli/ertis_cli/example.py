"""``ertis example``: shipped scenes, recordings and scripts."""

from pathlib import Path, PurePath
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem

from ertis_cli import _examples, _tables, options

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

__all__ = ["example"]


def _complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG001
    names = sorted({PurePath(name).stem for name in _examples.examples()})
    return [CompletionItem(name) for name in names if name.startswith(incomplete)]


@click.command()
@click.argument("names", metavar="[NAME]...", nargs=-1, shell_complete=_complete)
@click.option(
    "--output",
    "-o",
    "folder",
    type=click.Path(path_type=Path, file_okay=False),
    default=".",
    metavar="DIR",
    help="Folder to copy to; the current one by default.",
)
@options.force
@options.quiet
@options.as_json
def example(*, names: tuple[str, ...], folder: Path, force: bool, quiet: bool, as_json: bool) -> None:
    """List or copy shipped scenes, recordings and scripts.

    NAME is a file name, or a file name without its suffix: 'reflectors' copies the scene reflectors.toml and its
    recording reflectors.h5. A different file of the same name is overwritten only with --force.
    """
    if not names:
        _list(as_json=as_json)
        return
    from ertis_numba.atomic_files import atomic_write, check_target

    chosen: dict[str, Traversable] = {}
    for name in names:
        chosen |= _examples.named(name)
    contents = {folder / name: item.read_bytes() for name, item in chosen.items()}
    # An existing copy stays, so that commands from several pages can be run one after the other.
    missing = {path: content for path, content in contents.items() if not _holds(path, content)}
    for path in missing:
        check_target(path, overwrite=force)
    for path, content in missing.items():
        with atomic_write(path, overwrite=force) as part:
            part.write_bytes(content)
    for path in contents:
        options.say(f"{path}{'' if path in missing else ': copied before'}", quiet=quiet or as_json)
    if as_json:
        options.print_json({"files": [str(path) for path in contents], "copied": [str(path) for path in missing]})


def _list(*, as_json: bool) -> None:
    rows = [(name, _examples.description(name, item)) for name, item in _examples.examples().items()]
    if as_json:
        options.print_json({"examples": [{"name": name, "description": about} for name, about in rows]})
        return
    _tables.TextTable({"name": "left", "description": "left"}, rows).print()


def _holds(path: Path, content: bytes) -> bool:
    """Return True if a file is already a copy of the example."""
    return path.is_file() and not path.is_symlink() and path.read_bytes() == content
