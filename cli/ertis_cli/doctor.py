"""``ertis doctor``: whether this machine has what it takes."""

from dataclasses import asdict
from pathlib import Path

import click

from ertis_cli import _tables, options

__all__ = ["doctor"]

_MARKS = {"good": "ok", "note": "note", "bad": "BAD"}
_STYLES = {"ok": "green", "note": "yellow", "BAD": "red"}
_COLUMNS: dict[str, _tables.Side] = dict.fromkeys(("", "what", "found", "what to do"), "left")


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
    from ertis_cli._diagnosis import CHECKS, InstallationFinding
    from ertis_numba.errors import ArgumentError

    if not folder.is_dir():
        raise ArgumentError(f"--folder {folder} is no folder; give one that is there")
    found: list[InstallationFinding] = []
    with options.note_when_slow("looking ...", quiet=False):
        for name, look in CHECKS.items():
            try:
                found += look(folder)
            except Exception as error:  # noqa: BLE001  one thing that is broken does not hide the others
                reason = " ".join(str(error).split()) or type(error).__name__
                found.append(InstallationFinding(name, "bad", f"could not be looked at: {reason}", "tell its authors"))
    n_bad = sum(each.state == "bad" for each in found)
    if as_json:
        options.print_json({"problems": n_bad, "findings": [asdict(each) for each in found]})
    else:
        rows = [(_MARKS[each.state], each.what, each.text, each.remedy) for each in found]
        _tables.TextTable(_COLUMNS, rows, _STYLES).print()
    if n_bad:
        ctx.exit(1)
