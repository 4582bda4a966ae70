"""``ertis bench``: the tables of the README, measured here and now."""

import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

# The NumPy backends are compared on one thread; NumPy's BLAS reads this when it is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import click

from ertis_cli import options

__all__ = ["bench"]


def _count(default: int) -> Callable[..., Any]:
    return click.option(
        "--count",
        type=click.IntRange(min=1),
        default=default,
        show_default=True,
        metavar="N",
        help="Measurements each.",
    )


_update = click.option(
    "--update",
    "targets",
    multiple=True,
    type=click.Path(path_type=Path, dir_okay=False, exists=True, writable=True),
    metavar="FILE",
    help="Replace the table between the markers of a Markdown file; may be given again.",
)


@click.group()
def bench() -> None:
    """Measure this machine; results are checked before they are timed."""


@bench.command()
@_count(100)
@_update
@options.quiet
@options.as_json
def paper(**given: Any) -> None:
    """Bits to energyscape at the paper's 90, 1850 and 3000 directions."""
    from ertis_bench import paper as benchmark

    _run("paper", benchmark, **given)


@bench.command()
@_count(30)
@_update
@options.quiet
@options.as_json
def scaling(**given: Any) -> None:
    """Time against directions, ranges, microphones and threads."""
    from ertis_bench import scaling as benchmark

    _run("scaling", benchmark, **given)


@bench.command()
@_count(30)
@_update
@options.quiet
@options.as_json
def simulation(**given: Any) -> None:
    """Scene to bits, with the effects that a scene calls for and with all."""
    from ertis_bench import simulation as benchmark

    _run("simulation", benchmark, **given)


def _run(
    name: str, benchmark: ModuleType, *, count: int, targets: tuple[Path, ...], quiet: bool, as_json: bool
) -> None:
    from ertis_bench import tables

    for target in targets:
        tables.around(target, name)  # refused now rather than after minutes
    report = benchmark.run(count=count, say=lambda text: options.say(text, quiet=quiet))
    table: str = getattr(tables, name)(report)
    for target in targets:
        tables.update(target, name, table)
    if as_json:
        options.print_json(report)
    elif not targets:
        click.echo(table)
