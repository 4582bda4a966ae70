"""``ertis record``: the central node that stores what sensors send."""

from pathlib import Path

import click

from ertis_cli import _central_watch, _network, _supervisor, options
from ertis_cli._saving import withdrawn

__all__ = ["record"]

_FILE = click.Path(path_type=Path)


@click.command()
@click.option("--listen", metavar="ADDRESS", help="Where sensor nodes come; tcp://127.0.0.1:5601 by default.")
@click.option("--output", "-o", "folder", type=_FILE, required=True, metavar="DIR", help="Folder for recordings.")
@_central_watch.name
@_central_watch.rotate_size
@_central_watch.rotate_every
@_central_watch.max_bytes
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
    max_bytes: int,
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
    life = _supervisor.supervised()
    from ertis_numba.network.addresses import DEFAULT_LISTEN
    from ertis_numba.network.central_node import CentralNode

    _network.require_duration(duration)
    served = _network.metrics(metrics, lambda: node.latest)
    archive = _central_watch.archive(folder, name, rotate_size, rotate_every)
    watch = _central_watch.CentralWatch(life, quiet=quiet, as_json=as_json)
    node = CentralNode(
        life.addresses.get("address") or listen or DEFAULT_LISTEN,
        keys=_network.server_keys(key, allow),
        archive=archive,
        max_bytes=max_bytes,
        on_event=watch.event,
        on_stored=watch.stored if as_json and every else None,
    )
    with withdrawn(folder) as made:
        _central_watch.run(node, watch, made=made, metrics=served, duration_s=life.remaining_s(duration))
    _central_watch.report(node.latest, watch, event="recorded")
