"""``ertis record``: the central node that stores what sensors send."""

import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _network, options

if TYPE_CHECKING:
    from ertis_numba.network.status import Status

__all__ = ["record"]

_FILE = click.Path(path_type=Path)


@click.command()
@click.option("--listen", metavar="ADDRESS", help="Where sensor nodes come; tcp://127.0.0.1:5601 by default.")
@click.option("--output", "-o", "folder", type=_FILE, required=True, metavar="DIR", help="Folder for recordings.")
@click.option("--name", default="recording", show_default=True, help="Of recordings, before the time.")
@click.option(
    "--rotate-size", type=float, default=2000.0, show_default=True, metavar="MB", help="Of a recording that is full."
)
@click.option(
    "--rotate-every", type=float, default=600.0, show_default=True, metavar="S", help="A new recording after so long."
)
@click.option("--duration", type=float, metavar="S", help="Seconds; until Ctrl-C by default.")
@_network.key
@_network.allow
@click.option("--metrics", metavar="HOST:PORT", help="Serve metrics for Prometheus there.")
@click.option("--every", is_flag=True, help="With --json: a line for each measurement, too.")
@options.quiet
@options.as_json
def record(
    *,
    listen: str | None,
    folder: Path,
    name: str,
    rotate_size: float,
    rotate_every: float,
    duration: float | None,
    key: str | None,
    allow: Path | None,
    metrics: str | None,
    every: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Be the central node that stores what sensors send.

    Sensors send to it by 'ertis capture --to ADDRESS'. What it acknowledges is durable, in a journal in DIR;
    recordings appear there complete, one after the other, and at the end. What a crash leaves is made a recording when
    it is started again, or by 'ertis recover'. Ctrl-C ends it; with --json there is a line for each event.
    """
    from contextlib import ExitStack

    from ertis_cli._central_watch import CentralWatch
    from ertis_cli._watch import stopped_by_signals
    from ertis_numba.network.addresses import DEFAULT_LISTEN
    from ertis_numba.network.central_node import Archive, CentralNode

    watch = CentralWatch(quiet=quiet, as_json=as_json)
    archive = Archive(folder, name, rotate_bytes=1e6 * rotate_size, rotate_s=rotate_every)
    node = CentralNode(
        listen or DEFAULT_LISTEN,
        keys=_network.server_keys(key, allow),
        archive=archive,
        on_event=watch.event,
        on_stored=watch.stored if as_json and every else None,
    )
    stop = threading.Event()
    with stopped_by_signals() as signals, ExitStack() as stack:
        stack.callback(watch.close)
        signals.obey(stop.set)  # before anybody is told that it listens, and may want it to end
        stack.enter_context(node)
        if metrics is not None:
            from ertis_numba.network.metrics import Metrics

            stack.enter_context(Metrics(metrics, lambda: node.latest))
        with watch.shows(lambda: node.latest):
            node.run(stop, duration)
    report(node.latest, watch.recordings, quiet=quiet, as_json=as_json)


def report(status: "Status", recordings: list[str], *, quiet: bool, as_json: bool) -> None:
    """Tell what has come of it; leave with an exit code of 1 where journals are left."""
    import msgspec

    sensors = status.sensors
    stored = sum(each.stored for each in sensors.values())
    missing = sum(sum(each.missing.values()) for each in sensors.values())
    archive = status.archive
    left = 0 if archive is None else archive.sealing
    if as_json:
        told: dict[str, Any] = {
            "stored": stored,
            "missing": missing,
            "recordings": recordings,
            "unsealed": left,
            "refused": status.refused,
            "seconds": status.uptime_s,
            "ack": None if archive is None else msgspec.to_builtins(archive.ack),
            "commit": None if archive is None else msgspec.to_builtins(archive.commit),
            "sensors": {
                name: {
                    "stored": each.stored,
                    "missing": each.missing,
                    "repeated": each.repeated,
                    "conflicts": each.conflicts,
                    "settled": each.settled,
                }
                for name, each in sensors.items()
            },
        }
        options.print_json({"event": "recorded"} | told)
    options.say(f"{options.counted(stored, 'measurement')} stored, {missing} missing", quiet=quiet)
    for name, each in sensors.items():
        for reason, count in each.missing.items():
            options.say(f"{name}: {count} missing, {reason}", quiet=quiet)
    if left:
        folder = "" if archive is None else archive.folder
        click.echo(f"{options.counted(left, 'journal')} not sealed; seal by 'ertis recover {folder}'", err=True)
        sys.exit(1)
