"""``ertis example``: list or write example scenes, recordings and scripts."""

from importlib.resources import as_file
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem

from ertis_cli import _examples, _tables, options

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

__all__ = ["example"]


def _complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG001
    names = sorted({_examples.stem(name) for name in _examples.examples()})
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
    help="Folder to write to; the current one by default.",
)
@options.force
@options.quiet
@options.as_json
@click.pass_context
def example(
    ctx: click.Context, *, names: tuple[str, ...], folder: Path, force: bool, quiet: bool, as_json: bool
) -> None:
    """List or write example scenes, recordings and scripts.

    NAME is a file name, or a file name without its suffix: 'reflectors' copies the scene reflectors.toml and simulates
    its recording reflectors.h5. Without NAME, list all examples. An unchanged example is kept; a different file of
    the same name is overwritten only with --force.
    """
    if not names:
        _list(as_json=as_json)
        return
    from ertis_numba.base.atomic_files import atomic_write, check_target

    sources: dict[Path, Traversable] = {}
    for name in names:
        sources |= {folder / file: item for file, item in _examples.named(name).items()}
    # An example that was written before stays, so that commands from several pages can be run one after the other.
    missing = [path for path, item in sources.items() if not _examples.is_written(path, item)]
    for path in missing:
        check_target(path, overwrite=force)
    quiet = quiet or as_json
    for path, item in sources.items():
        if path not in missing:
            options.say(f"{path}: unchanged", quiet=quiet)
        elif path.suffix == ".h5":
            _simulate(ctx, item, path, force=force, quiet=quiet)
        else:
            with atomic_write(path, overwrite=force) as part:
                part.write_bytes(_examples.content(path, item))
            options.say(str(path), quiet=quiet)
    if as_json:
        options.print_json({"files": [str(path) for path in sources], "written": [str(path) for path in missing]})


def _simulate(ctx: click.Context, scene: "Traversable", target: Path, *, force: bool, quiet: bool) -> None:
    """Run ``ertis simulate``, regardless of its variables and its section of a configuration file."""
    from ertis_cli.simulate import simulate

    unset = dict.fromkeys(["count", "seed", "sensor", "tolerance_db"])
    with as_file(scene) as path:
        ctx.invoke(simulate, path=path, target=target, force=force, quiet=quiet, explain=False, as_json=False, **unset)


def _list(*, as_json: bool) -> None:
    rows = [(name, _examples.description(name, item)) for name, item in _examples.examples().items()]
    if as_json:
        options.print_json({"examples": [{"name": name, "description": about} for name, about in rows]})
        return
    _tables.TextTable({"name": "left", "description": "left"}, rows).print()
