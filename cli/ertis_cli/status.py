"""``ertis sensors status``: show the status of a central node."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _network, _progress, _tables, options
from ertis_cli._central_watch import size
from ertis_cli._naming import with_options

if TYPE_CHECKING:
    from rich.console import Group

    from ertis_numba.network.central_client import CentralClient
    from ertis_numba.network.status import ArchiveStatus, Percentiles, Status

__all__ = ["status"]

_REFRESH_S = 1.0
_ALARMING = ("away: ", "fault: ")


@click.command()
@click.argument("address", metavar="ADDRESS")
@_network.key
@_network.server_key
@click.option("--once", is_flag=True, help="Show the status once, even on a terminal.")
@click.option(
    "--watch",
    is_flag=True,
    help="Show the status repeatedly, even without a terminal; with --json, one line each time.",
)
@click.option(
    "--patience",
    type=float,
    default=3.0,
    show_default=True,
    metavar="S",
    help="Longest time in seconds to wait for an answer.",
)
@options.as_json_of("one object; with --watch one per line for each refresh")
def status(
    *,
    address: str,
    key: str | None,
    server_key: str | None,
    once: bool,
    watch: bool,
    patience: float,
    as_json: bool,
) -> None:
    """Show the status of a central node.

    ADDRESS is the address that sensors send to, or the address at which the central node publishes. On a terminal, the
    display is refreshed every second. If the central node uses keys, pass the key of an application or an admin. If
    the node disappears, the command waits for it.
    """
    from ertis_numba.base import checks
    from ertis_numba.network.central_client import CentralClient

    if once and watch:
        raise click.UsageError("--once and --watch cannot be combined; choose one of them")
    checks.positive("--patience", patience)
    with CentralClient(address, keys=_network.client_keys(key, server_key)) as node:
        if as_json or once or not _progress.is_drawn_on(sys.stdout):
            for now, away in _looks(node, patience, again=watch):
                _print(now, away, as_json=as_json)
            return
        with _live() as show:
            for now, away in _looks(node, patience, again=True):
                show(_drawn(now, away))


def _looks(node: "CentralClient", patience_s: float, *, again: bool) -> "Iterator[tuple[Status, str]]":
    """Yield the current status, or the last one and the reason for a missing answer; the first must be answered."""
    from ertis_numba.base.errors import NetworkError

    now = node.status(patience_s)
    yield now, ""
    while again:
        time.sleep(_REFRESH_S)
        try:
            now, away = node.status(patience_s), ""
        except NetworkError as error:  # the node may restart
            away = with_options(str(error))
        yield now, away


def _print(now: "Status", away: str, *, as_json: bool) -> None:
    if as_json:
        import msgspec

        event = {"address": now.address, "text": away} if away else msgspec.to_builtins(now)
        options.print_json({"event": "away" if away else "status"} | event)
        return
    if _progress.is_drawn_on(sys.stdout):
        from rich.console import Console

        Console(file=sys.stdout).print(_drawn(now, away))
        return
    above, table, below = _reported(now, away)
    for line in (*above, *table.lines(), *below):
        click.echo(line)


@contextmanager
def _live() -> "Iterator[Any]":
    from rich.live import Live

    with Live(auto_refresh=False, screen=False) as live:
        yield lambda drawn: live.update(drawn, refresh=True)


def _drawn(now: "Status", away: str = "") -> "Group":
    """Return the output of `_reported` for drawing with rich."""
    from rich.console import Group
    from rich.text import Text

    above, table, below = _reported(now, away)
    lines = [Text(line, "bold red" if line.startswith(_ALARMING) else "") for line in above]
    return Group(*lines, table, *map(Text, below))


def _reported(now: "Status", away: str) -> tuple[list[str], _tables.TextTable, list[str]]:
    """Return the table of sensors and the lines above and below it; ``away`` marks them as outdated."""
    keys = "with keys" if now.keys else "without keys"
    head = (
        f"{now.address} on {now.host}, {now.state}, up {_seconds(now.uptime_s)}, "
        f"{options.counted(now.peers, 'sensor node')}, {keys}, {now.memory_bytes / 1e6:.0f} MB"
    )
    above = [f"away: {away}; last status:"] if away else []
    above.append(head)
    if now.fault:
        above.append(f"fault: {now.fault}")
    if now.refused:
        above.append(f"refused: {_by_reason(now.refused)}")
    return above, _sensors(now), [*_below(now)]


def _sensors(now: "Status") -> _tables.TextTable:
    processing, archive = now.processing is not None, now.archive is not None
    headings = ["Hz", "received", *(["stored"] if archive else []), *(["published"] if processing else []), "queue"]
    columns: dict[str, _tables.Side] = {"sensor": "left", **dict.fromkeys(headings, "right"), "missing": "left"}
    if processing:
        columns |= {"dropped": "left", "image ms p50/p99": "right"}
    rows = []
    for name, each in now.sensors.items():
        row = [f"{each.rate_hz:.1f}", str(each.received)]
        row += [str(each.stored)] if archive else []
        row += [str(each.published)] if processing else []
        row += [str(each.queue), _by_reason(each.missing)]
        row += [_by_reason(each.dropped), _times(each.image_latency)] if processing else []
        rows.append((name if each.connected else f"{name} (away)", *row))
    return _tables.TextTable(columns, rows)


def _below(now: "Status") -> Iterator[str]:
    """Yield lines about storage and processing."""
    archive, processing = now.archive, now.processing
    if archive is not None:
        failed = f", {archive.sealing_failed} not sealed" if archive.sealing_failed else ""
        failed += f", {archive.set_aside} set aside" if archive.set_aside else ""
        poses = f", {options.counted(archive.poses, 'pose')} received" if archive.poses else ""
        yield (
            f"archive {archive.folder}: {_writing(archive, fault=bool(now.fault))}, {archive.sealed} sealed, "
            f"{archive.sealing} to seal{failed}{poses}"
        )
        yield (
            f"disk: {size(archive.free_bytes)} free, room for {size(archive.room_bytes)}; "
            f"commit {_times(archive.commit)} ms, ack {_times(archive.ack)} ms (p50/p99)"
        )
    if processing is not None:
        busy = sum(worker.state == "busy" for worker in processing.workers)
        yield (
            f"workers: {len(processing.workers)}, {busy} busy, {_times(processing.process_time)} ms (p50/p99), "
            f"{processing.respawned} respawned, {processing.retried} retried, {processing.quarantined} quarantined"
        )
        if processing.choice:
            yield f"cores: {processing.choice}"
        passive = {name: each.passive for name, each in now.sensors.items() if each.passive}
        if passive:
            yield f"without a call, published without images: {_by_reason(passive)}"
        if processing.groups:
            yield f"groups: {_by_reason(processing.groups)}"
        yield f"published at {processing.address or 'no address'} to {len(processing.subscribers)}"
        for each in processing.subscribers:
            sensors = "all sensors" if each.sensors is None else " ".join(each.sensors)
            yield f"  {each.name}: {' '.join(each.products)} of {sensors}, {each.sent} sent, {each.dropped} dropped"


def _writing(archive: "ArchiveStatus", *, fault: bool) -> str:
    """Return the state of the archive's current recording."""
    if not archive.recording:
        return "not writable" if fault else "no recording yet"
    doing = "is not writable" if fault else "is being written"
    return f"{archive.recording} {doing}, {size(archive.journal_bytes)} in its journal"


def _by_reason(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in counts.items()) or "0"


def _times(times: "Percentiles") -> str:
    return f"{times.p50_ms:.1f}/{times.p99_ms:.1f}"


def _seconds(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"
