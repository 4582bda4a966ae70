"""Implementation of ``ertis doctor``, which checks an installation."""

from dataclasses import asdict
from pathlib import Path

import click

from ertis_cli import _tables, options

__all__ = ["doctor"]

_MARKS = {"good": "ok", "note": "note", "bad": "BAD"}
_STYLES = {"ok": "green", "note": "yellow", "BAD": "red"}
_COLUMNS: dict[str, _tables.Side] = dict.fromkeys(("", "what", "found", "remedy"), "left")


@click.command()
@click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False),
    default=".",
    metavar="DIR",
    help="Folder for recordings, whose disk is measured; the current folder by default.",
)
@click.pass_context
@options.as_json
def doctor(ctx: click.Context, *, folder: Path, as_json: bool) -> None:
    """Check this installation and suggest fixes.

    Checks versions, cores and threads, GPU, serial ports and their permissions, speed and free space of the disk, and
    keys. The exit code is 1 if a part does not work; a missing optional part is only a note.
    """
    from ertis_cli._diagnosis import CHECKS, InstallationFinding
    from ertis_numba.errors import ArgumentError

    if not folder.is_dir():
        raise ArgumentError(f"--folder {folder} does not exist; give an existing folder")
    found: list[InstallationFinding] = []
    with options.note_when_slow("looking ...", quiet=False):
        for name, look in CHECKS.items():
            try:
                found += look(folder)
            except Exception as error:  # noqa: BLE001  one thing that is broken does not hide the others
                reason = " ".join(str(error).split()) or type(error).__name__
                found.append(InstallationFinding(name, "bad", f"check failed: {reason}", "report this to the authors"))
    n_bad = sum(each.state == "bad" for each in found)
    if as_json:
        options.print_json({"problems": n_bad, "findings": [asdict(each) for each in found]})
    else:
        rows = [(_MARKS[each.state], each.what, each.text, each.remedy) for each in found]
        _tables.TextTable(_COLUMNS, rows, _STYLES).print()
    if n_bad:
        ctx.exit(1)
