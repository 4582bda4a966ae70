"""``ertis sensors check``: fitness of sensors for use, from their recordings."""

import functools
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _tables, options
from ertis_cli._naming import with_options

if TYPE_CHECKING:
    from ertis_numba.sensor_check import RecordingCheck, SensorCheck
    from ertis_numba.settings import ExcludedChannels

__all__ = ["check"]

_STYLES = {"ok": "green", "fault": "red", "not known": "yellow"}
_UNFIT = 1


@click.command()
@options.input_files("REC.h5...")
@click.option(
    "--settings",
    "settings_file",
    type=options.FILE,
    metavar="FILE",
    help="Settings to check against, such as another layout or call; keys in FILE replace those in the recording.",
)
@options.without("Channels to exclude from the check, such as those with known faults")
@click.option(
    "--rate",
    "nominal_rate_hz",
    type=click.FloatRange(0, min_open=True),
    metavar="HZ",
    help="Nominal rate of measurements or pulses; the drift of the clock is measured relative to it.",
)
@click.option("--report", "page", type=options.FILE, metavar="FILE.html", help="HTML page to write.")
@options.force
@options.quiet
@options.as_json
@click.pass_context
def check(
    ctx: click.Context,
    *,
    paths: tuple[Path, ...],
    settings_file: Path | None,
    without: "ExcludedChannels",
    nominal_rate_hz: float | None,
    page: Path | None,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Check whether sensors are fit for use.

    'ertis verify' examines the file of a recording instead, and 'ertis info --health' lists single microphones.

    The command examines recordings of new, moved or repaired sensors: microphones, noise, losses, timing, call and
    calibration. At most 8 measurements of each sensor, evenly spaced, are examined. Measurements without a call show
    neither call nor calibration, and are examined only if there are no others. The last line for each file has the
    verdict, all faults and their remedies.

    The exit code is 0 if all sensors are fit for use, and 1 if a fault was found or a file cannot be read. The page of
    --report lists every file. A check is "not known" if the recording does not show its result; this is not a fault.
    """
    from ertis_numba.base import checks
    from ertis_numba.base.atomic_files import check_target
    from ertis_numba.base.errors import ErtisError
    from ertis_numba.sensor_check import check_recording, uncheckable_recording, write_page

    if nominal_rate_hz is not None:
        checks.between("--rate", nominal_rate_hz, 1e-6, 1e6)
    if page is not None:
        check_target(page, overwrite=force, sources=paths)
        page.unlink(missing_ok=True)  # If this command fails, the verdict of an earlier one must not remain.
    used = None
    if settings_file is not None:
        used = functools.partial(options.settings_with, settings_file=settings_file)
    found: list[RecordingCheck] = []
    for path in paths:
        try:
            with options.note_when_slow(f"checking {path} ...", quiet=quiet):
                found.append(check_recording(path, settings=used, without=without, nominal_rate_hz=nominal_rate_hz))
        except (ErtisError, OSError) as error:
            found.append(uncheckable_recording(path, error))
            click.echo(f"ertis: error: {with_options(str(error))}", err=True)
            if as_json:
                options.print_json(_report(found[-1]) | {"error": with_options(str(error))})
            continue
        if as_json:
            options.print_json(_report(found[-1]))
        else:
            _print(found[-1], quiet=quiet)
    if page is not None:
        write_page(page, found, overwrite=force)
        options.say(f"{page}: report of {options.counted(len(found), 'file')}", quiet=quiet)
    ctx.exit(0 if all(each.is_fit for each in found) else _UNFIT)


def _print(checked: "RecordingCheck", *, quiet: bool) -> None:
    """Print a table for each sensor, and the verdict; if ``quiet``, only the verdict of sensors with faults."""
    for sensor in () if quiet else checked.sensors:
        click.echo(f"sensor {sensor.sensor}: {_about(sensor)}")
        rows = [(item.check, item.result, item.detail) for item in sensor.items]
        _tables.TextTable({"check": "left", "result": "left", "details": "left"}, rows, _STYLES).print()
    if not (quiet and checked.is_fit):
        click.echo(checked.verdict)


def _about(sensor: "SensorCheck") -> str:
    microphones = options.counted(sensor.n_microphones, "microphone")
    measurements = options.counted(sensor.stored.measurements, "measurement")
    passive = f", {sensor.n_passive} of them without a call" if sensor.n_passive else ""
    examined = f"{len(sensor.examined)} examined"
    return f"layout {sensor.settings.array.layout}, {microphones}, {measurements}{passive}, {examined}"


def _report(checked: "RecordingCheck") -> dict[str, Any]:
    """Return the object of ``--json`` for a file."""
    return {
        "file": str(checked.path),
        "fit": checked.is_fit,
        "verdict": checked.verdict,
        "not_known": checked.not_known,
        "faults": [asdict(fault) for fault in checked.faults],
        "sensors": [_sensor(each) for each in checked.sensors],
    }


def _sensor(checked: "SensorCheck") -> dict[str, Any]:
    health, stored, calibration = checked.health, checked.stored, checked.calibration
    return {
        "sensor": checked.sensor,
        "layout": checked.settings.array.layout,
        "microphones": checked.n_microphones,
        "measurements": stored.measurements,
        "examined": checked.examined,
        "passive": checked.n_passive,
        "missing": stored.missing,
        "damaged": [item.index for item in stored.damaged],
        "implausible_words": checked.words.reasons,
        "not_observable": () if health is None else tuple(map(str, health.not_observable)),
        "checks": [asdict(item) for item in checked.items],
        "faulty_channels": {} if health is None else health.faults,
        "noise_dbfs": None if health is None else health.noise_dbfs,
        "dynamic_range_db": None if health is None else health.dynamic_range_db,
        "clock": asdict(checked.clock),
        "call_loss_db": None if checked.call is None else checked.call.loss_db,
        "calibration": None if calibration is None else asdict(calibration),
    }
