"""``ertis recover``: recordings from what an interrupted capture left."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from ertis_cli import options

__all__ = ["recover"]

_STEPS = 100  # of progress


@click.command()
@click.argument("places", metavar="DIR|JOURNAL...", nargs=-1, required=True, type=click.Path(path_type=Path))
@options.force
@options.quiet
@options.as_json
@click.pass_context
def recover(ctx: click.Context, *, places: tuple[Path, ...], force: bool, quiet: bool, as_json: bool) -> None:
    """Make recordings of what a crash has left.

    A capture that was interrupted leaves a journal, in which is every measurement that it told to be stored. Its
    recording gets the name it was to have, and the journal goes; one that a running capture uses is left alone. In a
    folder, all files named *.journal are taken. The exit code is 1 if a journal could not be sealed.
    """
    journals = [journal for place in places for journal in _found(place)]
    if not journals:
        options.say(f"no journal in {', '.join(map(str, places))}", quiet=quiet)
    reports = []
    for journal in journals:
        report = {"journal": str(journal), **_seal(journal, force=force, quiet=quiet)}
        reports.append(report)
        if _failed(report):
            click.echo(f"ertis: error: {report['error']}", err=True)
        else:
            options.say(_told(report), quiet=quiet)
    if as_json:
        options.print_json({"journals": reports})
    ctx.exit(int(any(map(_failed, reports))))


def _found(place: Path) -> list[Path]:
    from ertis_numba.journal import SUFFIX

    return sorted(place.glob(f"*{SUFFIX}")) if place.is_dir() else [place]


def _seal(journal: Path, *, force: bool, quiet: bool) -> dict[str, Any]:
    """Seal a journal in a process of its own, which a failing disk may end, and return what that says at last."""
    # Without -P, a file in the folder where one happens to be could stand in for a module.
    command = [sys.executable, "-P", "-m", "ertis_numba.storage.sealing", "--json", *(["--force"] if force else [])]
    told: dict[str, Any] = {"error": f"{journal}: the process that seals it said nothing; it is still there"}
    with (
        subprocess.Popen(  # noqa: S603  this very package
            [*command, "--", str(journal)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as process,
        options.progress(_steps(process, told), length=_STEPS, label=journal.name, quiet=quiet) as shown,
    ):
        for _ in shown:
            pass
    return told


def _steps(process: "subprocess.Popen[str]", told: dict[str, Any]) -> Iterator[None]:
    """Yield so often as a share of the work is done, and put what the process says at last into ``told``."""
    n_told = 0
    for line in process.stdout or ():
        report = json.loads(line)
        if "of" not in report:
            told.clear()
            told.update(report)
            continue
        while n_told < _STEPS * report["done"] // report["of"]:
            n_told += 1
            yield


def _failed(report: dict[str, Any]) -> bool:
    return "error" in report and not report.get("in_use")


def _told(report: dict[str, Any]) -> str:
    """Return what became of a journal, in a line."""
    if "error" in report:
        return f"{report['journal']}: in use by a running capture; left alone"
    if report["recording"] is None:
        return f"{report['journal']}: no measurement was captured; removed"
    told = [options.counted(report["measurements"], "measurement"), f"{report['missing']} missing"]
    if report["damaged"]:
        told.append(f"of which {report['damaged']} damaged; the journal is kept as {report['set_aside']}")
    return f"{report['recording']}: {', '.join(told)}"
