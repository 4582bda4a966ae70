"""``ertis capture``: record measurements from sensors."""

import sys
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from ertis_cli import _mountings, _network, options
from ertis_cli._naming import with_options
from ertis_cli._recording_settings import recording_settings, settings_from, warn_without_images
from ertis_cli._saving import withdrawn
from ertis_cli._sending import Sending
from ertis_cli._sensors import ConfiguredSensors, named_sensors, opened_sensors, require_one_each, wait_for
from ertis_cli._stop_signals import Signals, stopped_by_signals
from ertis_cli._watch import Watch, report

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ertis_numba.devices.bits import BitCheck
    from ertis_numba.devices.capture import CaptureSession
    from ertis_numba.devices.setup import Setup

__all__ = ["capture"]


@click.command()
@click.option(
    "--port",
    "ports",
    multiple=True,
    required=True,
    metavar="PORT",
    help="Path, serial number or name of a sensor; repeat for several sensors.",
)
@options.output("Recording to write; SERIAL_TIME.h5 by default.")
@click.option("--to", "address", metavar="ADDRESS", help="Central node to send to, instead of writing a recording.")
@click.option(
    "--spool",
    type=options.FOLDER,
    metavar="DIR",
    help="With --to: keep measurements in this folder until the central node acknowledges them; in memory by default.",
)
@click.option(
    "--spool-size",
    "spool_mb",
    type=click.FloatRange(min=0, min_open=True),
    metavar="MB",
    help="Largest spool; above it, new measurements are refused. Limited by the free disk space by default.",
)
@click.option(
    "--ring",
    "ring_mb",
    type=click.FloatRange(min=0, min_open=True),
    metavar="MB",
    help="With --to: memory for measurements; 64 by default. When full without --spool, the oldest are overwritten.",
)
@click.option(
    "--fixed-settings", is_flag=True, help="With --to: refuse new settings from admins ('ertis sensors configure')."
)
@_network.key
@_network.server_key
@_mountings.mounting
@click.option(
    "--wait",
    "wait_s",
    type=click.FloatRange(min=0),
    default=0.0,
    show_default=True,
    metavar="S",
    help="Seconds to wait for ports that do not exist yet.",
)
@click.option(
    "-n",
    "--count",
    "n",
    type=click.IntRange(min=1),
    metavar="N",
    help="Number of measurements per sensor, or of SYNC pulses.",
)
@click.option("--duration", type=float, metavar="S", help="Duration in seconds; until Ctrl-C by default.")
@click.option(
    "--trigger",
    type=click.Choice(["command", "sync"]),
    default="command",
    show_default=True,
    help="Source of the trigger: a command of this program, or a pulse of the SYNC chain.",
)
@click.option("--rate", type=float, default=10.0, show_default=True, metavar="HZ", help="Rate of trigger commands.")
@click.option(
    "--pin", type=click.IntRange(1, 2), default=1, show_default=True, help="Input that receives the SYNC pulses."
)
@click.option("--passive", is_flag=True, help="Record without emitting the call.")
@click.option(
    "--listen-only", is_flag=True, help="Send nothing to the sensor, because another program has configured it."
)
@click.option("--emissions", type=int, default=1, show_default=True, metavar="N", help="Emissions per measurement.")
@click.option(
    "--emission-period",
    "emission_period_s",
    type=float,
    metavar="S",
    help="Time between two emissions of a measurement, in s; no pause by default.",
)
@recording_settings
@click.option("--name", "names", multiple=True, metavar="NAME", help="Name of a sensor; repeat in the order of --port.")
@click.option(
    "--patience",
    type=float,
    default=30.0,
    show_default=True,
    metavar="S",
    help="Longest time to wait for a silent or unplugged sensor, and for the central node at the end.",
)
@click.option("--check-bits/--no-check-bits", default=True, show_default=True, help="Refuse data that cannot be PDM.")
@click.option("--refuse-splices", is_flag=True, help="Also refuse data that seem to be cut and joined.")
@click.option("--dry-run", is_flag=True, help="Print the commands for the sensor, send nothing, and exit.")
@options.force
@options.quiet
@options.as_json_of("one object per line for each measurement and event; the last one is a summary")
def capture(
    *,
    ports: tuple[str, ...],
    target: Path | None,
    address: str | None,
    spool: Path | None,
    spool_mb: float | None,
    ring_mb: float | None,
    fixed_settings: bool,
    key: str | None,
    server_key: str | None,
    mounting: Path | None,
    wait_s: float,
    n: int | None,
    duration: float | None,
    trigger: Literal["command", "sync"],
    rate: float,
    pin: int,
    passive: bool,
    listen_only: bool,
    emissions: int,
    emission_period_s: float | None,
    names: tuple[str, ...],
    patience: float,
    check_bits: bool,
    refuse_splices: bool,
    dry_run: bool,
    force: bool,
    quiet: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """Record measurements, or send them to a central node.

    Each measurement is written durably to a journal beside the recording before it is reported. The complete recording
    appears at the end. Ctrl-C ends a capture after the current measurement. After a crash, 'ertis import journals'
    seals the journal. With --json, each measurement is reported in one line.

    With --to, measurements are sent to a central node ('ertis record' or 'ertis serve') and kept until it acknowledges
    them. With --spool, they are durable before they are reported. After a crash, the next capture sends the remaining
    measurements of the spool.
    """
    from ertis_numba.devices.setup import Setup

    settings = settings_from(**given)
    trigger = "sync" if listen_only else trigger
    setup_of = partial(Setup.of, active=not passive, pin=pin, emissions=emissions, emission_period_s=emission_period_s)
    setup = setup_of(settings)
    warn_without_images(settings)
    if dry_run:
        _print_commands(setup, as_json=as_json)
        return
    require_one_each(ports, names)
    _require_one_place(address, target, for_address=(spool, spool_mb, ring_mb, fixed_settings, key, server_key))
    _require_spool(spool, spool_mb)
    _network.require_duration(duration)
    from ertis_numba.base.atomic_files import check_target
    from ertis_numba.devices.capture import CaptureSession

    if target is not None:
        check_target(target, overwrite=force)
    reported = {"quiet": quiet, "as_json": as_json}
    is_fixed = fixed_settings or listen_only
    send = None
    if address is not None:
        send = Sending(address, settings, spool=spool, limits_mb=(spool_mb, ring_mb), is_fixed=is_fixed, **reported)
    watch = Watch(**reported) if send is None else send.watch
    with stopped_by_signals() as signals, ExitStack() as stack:
        made = stack.enter_context(withdrawn(spool))
        if send is not None:
            stack.enter_context(send.node(_network.client_keys(key, server_key)))
        wait_for(ports, wait_s, signals, quiet=quiet)
        sonars = named_sensors(ports, names, opened_sensors(ports, signals, stack, listen_only=listen_only))
        target = target or Path(_default_name(list(sonars)))
        if send is None:
            check_target(target, overwrite=force)
        sensors = ConfiguredSensors(sonars, setup_of, check_bits=check_bits, splices=refuse_splices)
        session = CaptureSession(
            sonars,
            settings,
            trigger=trigger,
            rate_hz=rate,
            n=n,
            duration_s=duration,
            patience_s=patience,
            mounting=_mountings.mountings(mounting, sonars),
            **watch.callbacks,
            configure=None if is_fixed else sensors.configure,
        )
        sensors.configure_all(settings, signals)
        _note_mounting(mounting, list(sonars), quiet=quiet)
        signals.obey(session.stop)
        made.clear()
        if send is None:
            failure = _record(session, watch, sensors.checks, target, signals=signals, stack=stack, overwrite=force)
        else:
            failure = send.run(session, sensors.checks, patience_s=patience)
        asked_to_end = list(signals.came)
    sent, n_lost = (None, 0) if send is None else (send.report, send.n_lost)
    report(address or target, session, watch.took, more=sent, n_lost=n_lost, **reported)
    _end(failure, asked_to_end, is_limited=n is not None or duration is not None)


def _end(failure: Exception | None, asked_to_end: "Sequence[int]", *, is_limited: bool) -> None:
    """Raise the error that ended a capture, or exit with the status of a signal before the requested end."""
    if failure is not None:
        raise failure
    if asked_to_end and is_limited:
        sys.exit(128 + asked_to_end[0])


def _record(
    session: "CaptureSession",
    watch: Watch,
    checks: "dict[str, BitCheck]",
    target: Path,
    *,
    signals: Signals,
    stack: ExitStack,
    overwrite: bool,
) -> Exception | None:
    """Capture into a recording; return the error that ended it early, or None."""
    from ertis_numba.journal import SUFFIX, Journal

    path = target.with_name(f"{target.name}{SUFFIX}")
    journal = stack.enter_context(
        Journal.create(path, target=target.name, source=f"capture of {', '.join(session.counts)}")
    )
    if journal.remark:
        options.warn(journal.remark)
    where = f"the measurements so far are safe in {path}; recover them with 'ertis import journals {path}'"
    failure = watch.run(session, journal, checks, where=where)
    if signals.came and not len(journal):
        journal.remove()
        signals.end()
    stack.close()
    _seal(path, failure, overwrite=overwrite)
    return failure


def _seal(path: Path, failure: Exception | None, *, overwrite: bool) -> None:
    """Seal the journal into a recording, then raise the error that ended the capture, if any."""
    from ertis_numba.base.errors import DataError
    from ertis_numba.journal import seal_in_subprocess

    try:
        sealed = seal_in_subprocess(path, overwrite=overwrite)
    except (OSError, ValueError) as error:
        where = f"the measurements are safe in {path}; recover them with 'ertis import journals {path}'"
        reported = f"{with_options(str(error))}; {where}"
        if failure is None:
            raise DataError(reported) from error
        click.echo(f"ertis: error: {reported}", err=True)
        raise failure from error
    except KeyboardInterrupt as interrupt:
        click.echo(str(interrupt), err=True)
        if failure is None:
            raise
        raise failure from interrupt
    if sealed.recording is None:
        raise failure or DataError(sealed.remark)
    if sealed.remark:
        click.echo(sealed.remark, err=True)


def _note_mounting(path: Path | None, sensors: "Sequence[str]", *, quiet: bool) -> None:
    remedy = "add --mounting FILE to combine their images"
    _mountings.note_unknown(sensors if path is None and len(sensors) > 1 else [], remedy, quiet=quiet)


def _require_one_place(address: str | None, target: Path | None, *, for_address: tuple[object, ...]) -> None:
    if address is None and any(for_address):
        raise click.UsageError(
            "--spool, --spool-size, --ring, --fixed-settings, --key and --server-key need a central node; add --to"
        )
    if address is not None and target is not None:
        raise click.UsageError("--to and --output cannot be combined; choose one of them")


def _require_spool(spool: Path | None, spool_mb: float | None) -> None:
    if spool_mb is not None and spool is None:
        raise click.UsageError("--spool-size is given without --spool; add --spool with its folder")


def _print_commands(setup: "Setup", *, as_json: bool) -> None:
    """Print the commands for a sensor, with all samples of the call in one line."""
    before, call, after = setup.before_call(), setup.call(), setup.after_call()
    if as_json:
        lines = [command.encode().decode().strip() for command in (*before, *call, *after)]
        options.print_json({"commands": lines})
        return
    rows = [(command.encode().decode().strip(), command.about) for command in before]
    rows.append((f"!C,0… to {len(call) - 1}", "samples of the call, unless the sensor already has them"))
    rows += [(command.encode().decode().strip(), command.about) for command in after]
    for line, about in rows:
        click.echo(f"{line:20}  {about}")


def _default_name(sensors: list[str]) -> str:
    first = sensors[0] if len(sensors) == 1 else f"{sensors[0]}+{len(sensors) - 1}"
    return f"{first}_{datetime.now(UTC):%Y%m%dT%H%M%SZ}.h5"
