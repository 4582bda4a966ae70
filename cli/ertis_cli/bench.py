"""``ertis bench``: benchmarks that produce the tables of the documentation."""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

# The NumPy backends are compared on one thread. NumPy's BLAS reads this variable when it is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import click

from ertis_cli import options

__all__ = ["bench", "count_of", "run", "update"]


def count_of(default: int) -> Callable[..., Any]:
    """Return the option for the number of measurements per case."""
    return click.option(
        "--count",
        type=click.IntRange(min=1),
        default=default,
        show_default=True,
        metavar="N",
        help="Measurements per case.",
    )


update = click.option(
    "--update",
    "targets",
    multiple=True,
    type=click.Path(path_type=Path, dir_okay=False, exists=True, writable=True),
    metavar="FILE",
    help="Replace the table between the markers in a Markdown file; repeatable.",
)


class _Benchmarks(click.Group):
    """Benchmarks; those outside the wheel are registered by the package that it lacks."""

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a benchmark; refuse others in an installation without the source folder."""
        if cmd_name not in self.commands and self.commands.keys() == {"paper", "accuracy"}:
            raise click.UsageError(
                f"'ertis bench {cmd_name}' is not in this installation, which has only paper and accuracy; run "
                "'pip install --editable .' in the source folder",
                ctx,
            )
        return super().get_command(ctx, cmd_name)


@click.group(cls=_Benchmarks)
def bench() -> None:
    """Run benchmarks of speed and accuracy.

    The wheel contains paper and accuracy. The others exist only in the source folder.
    """
    from ertis_numba import kernels

    kernels.require_numba("'ertis bench'")


@bench.command()
@count_of(100)
@update
@options.quiet
@options.as_json
def paper(**given: Any) -> None:
    """Time the signal chain at 90, 1850 and 3000 directions."""
    from ertis_bench import paper as benchmark

    run("paper", benchmark, **given)


@bench.command()
@count_of(20)
@click.option(
    "--directions", metavar="GRID", default="3000", show_default=True, help="Directions, as in 'ertis process'."
)
@click.option(
    "--plot",
    "picture",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FRONT.png",
    help="Plot error versus time to this file, which is overwritten.",
)
@update
@options.quiet
@options.as_json
def accuracy(*, picture: Path | None, **given: Any) -> None:
    """Measure image error versus time.

    Compares about twenty plans and the paper's method.
    """
    from ertis_bench import accuracy as benchmark

    if picture and not picture.absolute().parent.is_dir():  # refuse now rather than after minutes
        raise click.BadParameter(f"folder {picture.parent} does not exist; create it first", param_hint="--plot")
    report = run("accuracy", benchmark, **given)
    if picture:
        benchmark.plot(report, picture)


def run(
    name: str, benchmark: ModuleType, *, targets: tuple[Path, ...], quiet: bool, as_json: bool, **given: Any
) -> dict[str, Any]:
    """Run a benchmark, print or write its tables, and return its report."""
    from ertis_bench import markdown, tables

    parts = given.get("only", ())
    forms = getattr(benchmark, "FORMS", None) or tables.FORMS[name]
    # Files without a place are refused before minutes of work.
    places = [(target, *markdown.place(target, "ertis bench", forms, parts)) for target in targets]
    report: dict[str, Any] = benchmark.run(say=lambda text: options.say(text, quiet=quiet), **given)
    for target, form, marker in places:
        markdown.update(target, marker, forms[form](report))
    if as_json:
        options.print_json(report)
    elif not targets:
        click.echo(forms[name](report))
    return report


if importlib.util.find_spec("ertis_cli.source_benchmarks"):
    importlib.import_module("ertis_cli.source_benchmarks")
