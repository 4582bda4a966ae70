"""``ertis verify``: check files for gaps and damage."""

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options
from ertis_cli._naming import with_options
from ertis_numba.base.units import runs

if TYPE_CHECKING:
    from ertis_numba.storage.verify import SensorReport

__all__ = ["verify"]

_FAILED, _INCOMPLETE = 1, 3


@click.command()
@options.input_files("FILE...")
@options.quiet
@options.as_json
@click.pass_context
def verify(ctx: click.Context, *, paths: tuple[Path, ...], quiet: bool, as_json: bool) -> None:
    """Verify that files are intact, and list gaps and damage.

    'ertis sensors check' examines the sensor of a recording instead, and 'ertis import journals' recovers journals.

    The command compares each measurement of recordings and journals, and each pose of journals, with its checksum. The
    exit code is 0 if all measurements are present, and all measurements and poses are intact. It is 3 if measurements
    are missing or out of order, or if measurements or poses are damaged, and 1 if a file cannot be read.
    """
    from ertis_numba.base.errors import ErtisError
    from ertis_numba.storage.verify import verify as verified

    files: list[dict[str, Any]] = []
    code = 0
    for path in paths:
        try:
            reports = verified(path)
        except (ErtisError, OSError) as error:
            click.echo(f"ertis: error: {with_options(str(error))}", err=True)
            files.append({"file": str(path), "error": with_options(str(error))})
            code = _FAILED
            continue
        whole = all(report.is_intact for report in reports)
        code = code or (0 if whole else _INCOMPLETE)
        sensors = [{**asdict(report), "missing": report.missing, "whole": report.is_intact} for report in reports]
        files.append({"file": str(path), "whole": whole, "sensors": sensors})
        if not (quiet or as_json):
            for report in reports:
                click.echo(f"{path}  {_line(report)}")
    if as_json:
        options.print_json({"files": files})
    ctx.exit(code)


def _line(report: "SensorReport") -> str:
    """Return a line with the findings for a sensor."""
    if report.fault:
        return f"{report.sensor}: {report.fault}"
    reported = [options.counted(report.measurements, "measurement")]
    if report.gaps:
        gaps = "; ".join(f"{_span(gap.first, gap.last)}: {gap.reason}" for gap in report.gaps)
        reported.append(f"{report.missing} missing ({gaps})")
    if report.damaged:
        reported.append(f"{len(report.damaged)} damaged (at {_places(item.index for item in report.damaged)})")
    if report.out_of_order:
        reported.append(f"{len(report.out_of_order)} out of order (at {_places(report.out_of_order)})")
    if report.copies:
        count = len(report.copies)
        kind = "copies" if count > 1 else "copy"
        reported.append(f"{count} {kind} of the measurement before (at {_places(report.copies)})")
    if report.remark:
        reported.append(report.remark)
    return f"{report.sensor}: {', '.join(reported)}{', whole' if report.is_intact else ''}"


def _places(places: Iterable[int]) -> str:
    """Return indices as text, with runs of neighbours as ranges."""
    return ", ".join(_span(first, last) for first, last in runs(places))


def _span(first: int, last: int) -> str:
    return str(first) if first == last else f"{first} to {last}"
