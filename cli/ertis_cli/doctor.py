"""``ertis doctor``: check an installation."""

from dataclasses import asdict
from pathlib import Path

import click

from ertis_cli import _tables, options

__all__ = ["doctor"]

_MARKS = {"good": "ok", "note": "note", "bad": "BAD"}
_STYLES = {"ok": "green", "note": "yellow", "BAD": "red"}
_COLUMNS: dict[str, _tables.Side] = dict.fromkeys(("", "check", "found", "remedy"), "left")


@click.command()
@click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False),
    default=".",
    metavar="DIR",
    help="Folder for recordings; the speed of its disk is measured. The current folder by default.",
)
@click.option("--ros", is_flag=True, help="Only check for reasons why ROS 2 programs receive nothing from 'ertis ros'.")
@click.option("--domain", type=int, metavar="N", help="With --ros: DDS domain; the value of ROS_DOMAIN_ID by default.")
@click.option("--interface", metavar="NAME", help="With --ros: network interface; lo by default.")
@click.pass_context
@options.as_json
def doctor(
    ctx: click.Context, *, folder: Path, ros: bool, domain: int | None, interface: str | None, as_json: bool
) -> None:
    """Check this installation and suggest fixes.

    The command checks versions, cores and threads, the GPU, serial ports and their permissions, disk speed and free
    space, and keys. With --ros, it checks only the environment and the network that ROS 2 topics need, and lists the
    subscribers that it finds. The exit code is 1 if something does not work. A missing optional part is a note, and
    does not change the exit code.
    """
    from ertis_cli._diagnosis import CHECKS, InstallationFinding
    from ertis_cli._ros_diagnosis import ros_findings
    from ertis_numba.base.errors import ArgumentError, ErtisError

    if not ros and (domain is not None or interface is not None):
        raise click.UsageError("--domain and --interface require --ros; add --ros")
    checks = {"ROS": lambda _: ros_findings(domain, interface or "lo")} if ros else CHECKS

    if not folder.is_dir():
        raise ArgumentError(f"--folder {folder} is not a folder; choose an existing folder")
    found: list[InstallationFinding] = []
    with options.note_when_slow("checking ...", quiet=False):
        for name, look in checks.items():
            try:
                found += look(folder)
            except ErtisError as error:
                text, _, remedy = " ".join(str(error).split()).rpartition("; ")
                found.append(InstallationFinding(name, "bad", text or remedy, remedy if text else ""))
            except Exception as error:  # noqa: BLE001  one broken check must not hide the others
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                found.append(InstallationFinding(name, "bad", f"check failed: {reason}", "report this as a bug"))
    n_bad = sum(each.state == "bad" for each in found)
    if as_json:
        options.print_json({"problems": n_bad, "findings": [asdict(each) for each in found]})
    else:
        rows = [(_MARKS[each.state], each.check, each.text, each.remedy) for each in found]
        _tables.TextTable(_COLUMNS, rows, _STYLES).print()
    if n_bad:
        ctx.exit(1)
