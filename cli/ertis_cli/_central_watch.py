"""Options and progress reports shared by the commands that run a central node."""

import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _watchdog, options
from ertis_cli._config import typed
from ertis_cli._lines import JsonLines
from ertis_cli._progress import StatusLine
from ertis_cli._stop_signals import stopped_by_signals

if TYPE_CHECKING:
    from typing import Self

    from ertis_cli._supervisor import Life
    from ertis_numba.network.central_node import Archive, CentralNode
    from ertis_numba.network.metrics import Metrics
    from ertis_numba.network.status import Status

__all__ = [
    "CentralWatch",
    "archive",
    "max_bytes",
    "name",
    "report",
    "require_use",
    "rotate_every",
    "rotate_size",
    "run",
    "size",
]

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

name: Decorator = click.option(
    "--name", default="recording", show_default=True, help="Name of recordings, followed by the time."
)
rotate_size: Decorator = click.option(
    "--rotate-size",
    type=float,
    default=2000.0,
    show_default=True,
    metavar="MB",
    help="Size at which a new recording starts.",
)
rotate_every: Decorator = click.option(
    "--rotate-every",
    type=float,
    default=600.0,
    show_default=True,
    metavar="S",
    help="Age at which a new recording starts.",
)
max_bytes: Decorator = click.option(
    "--max-bytes",
    "max_bytes",
    type=int,
    default=4 * 2**20,
    show_default=True,
    help="Largest measurement; larger ones are refused.",
)

_REFRESH_S = 0.5
_EXPECTED = {"listening", "joined", "left", "configure", "resumed", "sealed"}


def require_use(*, stores: bool, as_json: bool) -> None:
    """Raise an error for options without effect in a node that stores no measurements, or that prints no JSON."""
    context = click.get_current_context()
    for option in ("name", "rotate_size", "rotate_every", "every"):
        missing = "--record DIR" if not stores else "--json" if option == "every" and not as_json else ""
        if missing and typed(option):
            spelling = f"--{option.replace('_', '-')}"
            raise click.UsageError(f"{spelling} requires {missing}; add {missing}, or leave out {spelling}", context)


class CentralWatch:
    """Reporter of a node: JSON lines on stdout, log lines and, on a terminal, a progress line on stderr."""

    def __init__(self, life: "Life", *, quiet: bool, as_json: bool) -> None:
        from ertis_numba.network.log import logger, show

        self._out, self._err = (
            JsonLines(sys.stdout),
            JsonLines(sys.stderr),
        )  # a slow reader must not block the event loop
        show(level="CRITICAL" if quiet else "INFO", stream=self._err)
        self._log = logger("central_node")
        self.life, self.quiet, self.as_json = life, quiet, as_json
        self._line = StatusLine(self._err.write, quiet=quiet)
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self.recordings: list[str] = []
        if life.restarts:
            self.event({"event": "restarted", "restarts": life.restarts, "reason": life.reason})

    def event(self, event: dict[str, Any]) -> None:
        """Report an event of the central node."""
        if event["event"] == "sealed" and event["recording"] is not None:
            self.recordings.append(event["recording"])
        self.life.note(event)
        if self.as_json:
            self._print(event)
        if self.quiet:
            return
        self._line.clear()
        fields = {name: value for name, value in event.items() if name != "event" and value != ""}
        (self._log.info if event["event"] in _EXPECTED else self._log.warning)(event["event"], **fields)

    def stored(self, sensor: str, session_id: int, sequence: int, crc32: int) -> None:
        """Report a durable measurement."""
        self._print(
            {"event": "stored", "sensor": sensor, "session_id": session_id, "sequence": sequence, "crc32": crc32}
        )

    def _print(self, event: dict[str, Any]) -> None:
        self._out.write(f"{json.dumps(event, allow_nan=False)}\n")

    def shows(self, status: "Callable[[], Status]") -> "Self":
        """Draw a progress line on a terminal until the ``with`` block ends."""
        if self._line.is_drawn:
            self._thread = threading.Thread(target=self._draw, args=(status,), daemon=True)
        return self

    def __enter__(self) -> "Self":
        if self._thread is not None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._thread is not None:
            self._ended.set()
            self._thread.join()
            self._line.clear()

    def close(self) -> None:
        """Write pending lines, and report lines that were dropped."""
        if self._out.lost:
            self._print({"event": "untold", "count": self._out.lost})
        self._out.close()
        self._err.close()

    def _draw(self, status: "Callable[[], Status]") -> None:
        while not self._ended.wait(_REFRESH_S):
            self._line.draw(_progress(status()))


def archive(folder: Path, name: str, rotate_mb: float, rotate_s: float) -> "Archive":
    """Return an archive that stores measurements according to the options."""
    from ertis_numba.base import checks
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.network.central_node import Archive

    checks.between("--rotate-size", rotate_mb, 1.0, 1e9)
    checks.between("--rotate-every", rotate_s, 1.0, 1e9)
    try:
        checks.sensor_name(name)
    except ArgumentError as error:
        raise ArgumentError(str(error).replace("sensor name", "--name", 1)) from error
    return Archive(folder, name, rotate_bytes=1e6 * rotate_mb, rotate_s=rotate_s)


def run(
    node: "CentralNode",
    watch: CentralWatch,
    *,
    made: list[Path],
    metrics: "Metrics | None",
    duration_s: float | None,
) -> None:
    """Run a central node until it is asked to end; clear ``made``, from `withdrawn`, once it runs."""
    with stopped_by_signals() as signals, ExitStack() as stack:
        stack.callback(watch.close)
        signals.obey(node.stop)  # before the central node reports that it listens
        stack.enter_context(node)
        if metrics is not None:
            stack.enter_context(metrics)
        made.clear()
        with watch.shows(lambda: node.latest), _watchdog.follow(lambda: node.latest.uptime_s):
            node.run(duration_s)


def size(n_bytes: float) -> str:
    """Return a number of bytes as readable text."""
    return f"{n_bytes / 1e9:.1f} GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.0f} MB"


def report(status: "Status", watch: CentralWatch, *, event: str) -> None:
    """Report the results of a central node; exit with code 1 if unsealed journals remain."""
    import msgspec

    quiet = watch.quiet

    sensors, archive = status.sensors, status.archive
    missing: Counter[str] = Counter()
    for each in sensors.values():
        missing.update(each.missing)
    left = 0 if archive is None else archive.sealing
    if watch.as_json:
        reported = {
            "received": sum(each.received for each in sensors.values()),
            "stored": sum(each.stored for each in sensors.values()),
            "missing": missing,
            "recordings": watch.recordings,
            "unsealed": left,
            "refused": status.refused,
            "seconds": status.uptime_s,
            "restarts": watch.life.restarts,
            "ack": None if archive is None else archive.ack,
            "commit": None if archive is None else archive.commit,
            "processing": status.processing,
            "sensors": sensors,
        }
        options.print_json({"event": event} | msgspec.to_builtins(reported))
    options.say(
        f"{options.counted(sum(each.received for each in sensors.values()), 'measurement')} received, "
        f"{missing.total()} missing",
        quiet=quiet,
    )
    for sensor, each in sensors.items():
        parts = [f"{each.received} received"]
        if archive is not None:
            parts.append(f"{each.stored} stored")
        if status.processing is not None:
            without = f", {each.passive} of them without an image, because no call was emitted" if each.passive else ""
            parts.append(f"{each.published} published{without}")
        parts += [f"{count} dropped ({reason})" for reason, count in each.dropped.items()]
        parts += [f"{count} missing ({reason})" for reason, count in each.missing.items()]
        options.say(f"{sensor}: {', '.join(parts)}", quiet=quiet)
    if archive is not None and left:
        click.echo(
            f"{options.counted(left, 'journal')} not sealed; seal with 'ertis import journals {archive.folder}'",
            err=True,
        )
        click.get_current_context().exit(1)


def _progress(status: "Status") -> str:
    """Return the progress line."""
    sensors = status.sensors.values()
    parts = [
        f"{sum(each.connected for each in sensors)} sensors",
        " ".join(f"{each.rate_hz:.1f}" for each in sensors if each.connected)[:40] + " Hz",
    ]
    if status.archive is not None:
        parts.append(f"{sum(each.stored for each in sensors)} stored")
        parts.append(f"ack p99 {status.archive.ack.p99_ms:.0f} ms")
        parts.append(f"{size(status.archive.room_bytes)} left")
    if status.processing is not None:
        parts.append(f"{sum(each.published - each.passive for each in sensors)} images")
        parts.append(f"{sum(sum(each.dropped.values()) for each in sensors)} dropped")
    if status.state == "fault":
        parts.append(f"FAULT: {status.fault}")
    return f"{time.strftime('%H:%M:%S')}   {'   '.join(parts)}"
