"""``ertis record``: run a central node that stores measurements."""

from pathlib import Path

import click

from ertis_cli import _central_watch, _network, _supervisor, options
from ertis_cli._saving import withdrawn

__all__ = ["record"]


@click.command()
@click.option("--listen", metavar="ADDRESS", help="Address for sensor nodes; tcp://127.0.0.1:5601 by default.")
@click.option(
    "--output", "-o", "folder", type=options.FOLDER, required=True, metavar="DIR", help="Folder for recordings."
)
@_central_watch.name
@_central_watch.rotate_size
@_central_watch.rotate_every
@_central_watch.max_bytes
@click.option("--duration", type=float, metavar="S", help="Duration in seconds; until Ctrl-C by default.")
@_network.key
@_network.allow
@click.option("--metrics", metavar="HOST:PORT", help="Serve Prometheus metrics at this address.")
@click.option("--every", is_flag=True, help="With --json: also print a line for each measurement.")
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
    """Run a central node that stores measurements.

    Sensors send to it with 'ertis capture --to ADDRESS'. The central node acknowledges a measurement once a journal in
    DIR contains it durably. Complete recordings appear in DIR one after the other, the last one at the end. After a
    crash, the next start or 'ertis import journals' seals the journals. Ctrl-C ends the node. With --json, there is one
    line per event.
    """
    _central_watch.require_use(stores=True, as_json=as_json)
    life = _supervisor.supervised()
    from ertis_numba.network.addresses import DEFAULT_LISTEN
    from ertis_numba.network.central_node import CentralNode

    _network.require_duration(duration)
    _network.require_address("--listen", listen)
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
