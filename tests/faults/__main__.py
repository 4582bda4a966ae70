"""Command ``python -m tests.faults``: run the trials, and write their tables into the documentation."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import click
from ertis_bench import markdown
from ertis_cli import options

from ertis_numba.base import checks
from ertis_numba.base.errors import ErtisError
from tests.faults import reliability as reliability_trials, reliability_table
from tests.faults.network import all_trials as network_trials, table as network_table

PROGRAM = "python -m tests.faults"


@click.group()
def faults() -> None:
    """Test faults and their consequences; nothing is timed."""


def _trials(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of all trials."""
    for option in (
        click.option("--long", is_flag=True, help="Run for hours instead of minutes."),
        click.option(
            "--fraction",
            type=click.FloatRange(min=0, max=1, min_open=True),
            default=1.0,
            help="With --long: fraction of its numbers and durations.",
        ),
        click.option("--seed", type=click.IntRange(min=0), metavar="S", help="Seed of the faults; random by default."),
        click.option("--only", multiple=True, metavar="PART", help="Run only this part; repeatable."),
        click.option(
            "--update",
            "targets",
            multiple=True,
            type=click.Path(path_type=Path, dir_okay=False, exists=True, writable=True),
            metavar="FILE",
            help="Replace the table between the markers in a Markdown file; repeatable.",
        ),
        options.quiet,
        options.as_json,
    ):
        command = option(command)
    return command


@faults.command()
@_trials
def reliability(**given: Any) -> None:
    """Test transmission faults, unplugged sensors, kill -9, power cuts and full disks of one host."""
    _run("reliability", reliability_trials, reliability_table.reliability, **given)


@faults.command()
@_trials
def network(**given: Any) -> None:
    """Test kill -9, bad disks and cables, wrong keys, hostile peers and overload of a network."""
    _run("network", network_trials, network_table.network, **given)


def _run(
    name: str,
    trials: ModuleType,
    form: Callable[[dict[str, Any]], str],
    *,
    targets: tuple[Path, ...],
    only: tuple[str, ...],
    quiet: bool,
    as_json: bool,
    long: bool,
    fraction: float,
    **given: Any,
) -> None:
    for part in only:
        checks.choice("--only", part, trials.PARTS)
    markers = [(target, markdown.place(target, PROGRAM, [name], only)[1]) for target in targets]
    report = trials.run(
        say=lambda text: options.say(text, quiet=quiet), only=only, fraction=fraction if long else 0.0, **given
    )
    for target, marker in markers:
        markdown.update(target, marker, form(report))
    if as_json:
        options.print_json(report)
    elif not targets:
        click.echo(form(report))


if __name__ == "__main__":
    try:
        faults(prog_name=PROGRAM)
    except ErtisError as error:
        raise SystemExit(str(error)) from None
