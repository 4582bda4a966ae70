"""``ertis doctor``: whether this machine has what it takes."""

from dataclasses import asdict
from pathlib import Path

import click

from ertis_cli import options

__all__ = ["doctor"]


@click.command()
@click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False),
    default=".",
    metavar="DIR",
    help="Where recordings will go: its disk is measured. The current one by default.",
)
@click.pass_context
@options.as_json
def doctor(ctx: click.Context, *, folder: Path, as_json: bool) -> None:
    """Look whether this machine has what it takes, and say what to do.

    Versions, cores and threads, GPU, serial ports and who may open them, speed and room of the disk, keys. The exit
    code is 1 if something does not work; what is only missing is a note.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from ertis_cli._diagnosis import CHECKS, Finding
    from ertis_numba.errors import ArgumentError

    if not folder.is_dir():
        raise ArgumentError(f"--folder {folder} is no folder; give one that is there")
    found: list[Finding] = []
    with options.note_when_slow("looking ...", quiet=False):
        for name, look in CHECKS.items():
            try:
                found += look(folder)
            except Exception as error:  # noqa: BLE001  one thing that is broken does not hide the others
                reason = " ".join(str(error).split()) or type(error).__name__
                found.append(Finding(name, "bad", f"could not be looked at: {reason}", "tell its authors"))
    n_bad = sum(each.state == "bad" for each in found)
    if as_json:
        options.print_json({"problems": n_bad, "findings": [asdict(each) for each in found]})
    else:
        table = Table(box=None, pad_edge=False)
        for heading in ("", "what", "found", "what to do"):
            table.add_column(heading, overflow="fold")
        marks = {"good": Text("ok", "green"), "note": Text("note", "yellow"), "bad": Text("BAD", "red")}
        for each in found:
            table.add_row(marks[each.state], *map(Text, (each.what, each.text, each.remedy)))
        Console(highlight=False).print(table)
    if n_bad:
        ctx.exit(1)
