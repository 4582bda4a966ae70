"""``ertis import signals``: recordings from signals and journals, and poses for them."""

from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

import click

from ertis_cli import options
from ertis_cli._naming import with_options
from ertis_cli.import_poses import import_poses
from ertis_cli.import_raw import import_raw

__all__ = ["imports"]


_STEPS = 100  # of progress
_FAILED, _INCOMPLETE = 1, 3


@click.command("journals")
@options.input_files("DIR|JOURNAL...", name="places")
@options.force
@options.quiet
@options.as_json
@click.pass_context
def recover(ctx: click.Context, *, places: tuple[Path, ...], force: bool, quiet: bool, as_json: bool) -> None:
    """Recover recordings from journals left by a crash.

    An interrupted capture leaves a journal with every measurement that it reported as stored. The command seals the
    journal into a recording with its intended name and removes the journal. It skips a journal that a running capture
    uses. In a folder, it recovers all files named *.journal. If a recording cannot hold a sensor, the command seals the
    others and keeps the journal under a name that ends in .refused. The exit code is 1 if something could not be
    sealed, and 3 if stored measurements or poses are damaged or lost.
    """
    journals = [journal for place in places for journal in _found(place)]
    if not journals:
        options.say(f"no journal in {', '.join(map(str, places))}", quiet=quiet)
    reports = []
    for journal in journals:
        report = _seal(journal, force=force, quiet=quiet)
        reports.append(report)
        if report.get("refused"):
            click.echo(f"ertis: error: {_refusal(report)}", err=True)
        elif _failed(report):
            click.echo(f"ertis: error: {report['error']}", err=True)
        if "error" in report and _failed(report):
            continue
        if report.get("lost") or report.get("damage"):
            options.warn(_reported(report))
        else:
            options.say(_reported(report), quiet=quiet)
    if as_json:
        options.print_json({"journals": reports})
    losses = ("damaged", "lost", "damage", "pose_damage")
    incomplete = any(report.get(loss) for report in reports for loss in losses)
    ctx.exit(_FAILED if any(map(_failed, reports)) else _INCOMPLETE if incomplete else 0)


def _found(place: Path) -> list[Path]:
    from ertis_numba.journal import SUFFIX

    return sorted(place.glob(f"*{SUFFIX}")) if place.is_dir() else [place]


def _seal(journal: Path, *, force: bool, quiet: bool) -> dict[str, Any]:
    """Seal a journal and return a report of the result."""
    from ertis_numba.base.errors import DataError, JournalInUseError
    from ertis_numba.journal import seal_in_subprocess

    with options.progress(range(_STEPS), length=_STEPS, label=journal.name, quiet=quiet) as shown:
        steps = iter(shown)
        n_reported = 0

        def progress(done: int, of: int) -> None:
            nonlocal n_reported
            for _ in islice(steps, _STEPS * done // of - n_reported):
                n_reported += 1

        try:
            sealed = seal_in_subprocess(journal, overwrite=force, progress=progress)
        except (DataError, OSError) as error:
            return {
                "journal": str(journal),
                "error": with_options(str(error)),
                "in_use": isinstance(error, JournalInUseError),
            }
        except KeyboardInterrupt as interrupt:
            click.echo(str(interrupt), err=True)
            raise
    return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(sealed).items()}


def _failed(report: dict[str, Any]) -> bool:
    return bool(report.get("refused")) or ("error" in report and not report.get("in_use"))


def _refusal(report: dict[str, Any]) -> str:
    """Return the reasons why sensors of a journal are missing in its recording, as one line."""
    reasons = "; ".join(f"no recording can hold sensor {name} ({why})" for name, why in report["refused"].items())
    return f"{report['journal']}: {reasons}; the journal is kept as {report['set_aside']}"


def _reported(report: dict[str, Any]) -> str:
    """Return a line that describes the result for a journal."""
    if "error" in report:
        return f"{report['journal']}: in use by a running capture; left alone"
    if report["recording"] is None and report["refused"]:
        return f"{report['journal']}: kept as {report['set_aside']}"
    if report["recording"] is None:
        return f"{report['journal']}: no measurement was captured; removed"
    reported = [options.counted(report["measurements"], "measurement")]
    if report["without_pose"]:
        reported.append(f"{report['without_pose']} without a pose")
    reported.append(f"{report['missing']} missing")
    if report["damaged"]:
        reported.append(f"of which {report['damaged']} damaged; the journal is kept as {report['set_aside']}")
    if report["pose_damage"]:
        reported.append(f"{report['pose_damage']}; the journal is kept as {report['set_aside']}")
    if report["lost"] or report["damage"]:
        reported.append(f"up to {report['lost']} of them stored, then lost in the journal's damaged log")
    if report["damage"]:
        reported.append(f"also lost: {report['damage']}")
    return f"{report['recording']}: {', '.join(reported)}"


class _Imports(click.Group):
    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Import signals if the first argument is no command, as of ``ertis import FILE.wav``."""
        is_command = args[0] in self.commands or args[0] in ctx.help_option_names
        return super().resolve_command(ctx, args if is_command else ["signals", *args])


@click.group("import", cls=_Imports, context_settings={"ignore_unknown_options": True})
def imports() -> None:
    """Import signals, journals left by a crash, or poses into recordings.

    If the first argument is none of these commands, it is a file of signals.
    """


for each in (import_raw, import_poses, recover):
    imports.add_command(each)
