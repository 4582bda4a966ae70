"""Reports of a capture: events, progress and summary."""

import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _watchdog, options
from ertis_cli._progress import StatusLine

if TYPE_CHECKING:
    from ertis_numba.devices.bits import BitCheck
    from ertis_numba.devices.capture import CaptureSession, MeasurementSink
    from ertis_numba.journal import JournalEntry

__all__ = ["Watch", "report"]

_REFRESH_S = 0.25
_ALIVE = 0.05  # minimum share of ones, and of zeros, of a working microphone


class Watch:
    """Reporter of a capture for several threads: JSON lines, notes, and a progress line."""

    word = "stored"  # state of a reported measurement

    def __init__(self, *, quiet: bool, as_json: bool) -> None:
        self._quiet, self._as_json = quiet, as_json
        self._context = click.get_current_context(silent=True)  # Other threads report events, too.
        self._turn = threading.Lock()
        self._line = StatusLine(partial(click.echo, err=True, nl=False), quiet=quiet)
        self._next_s = 0.0
        self.took: dict[str, float] = {}
        self._session: CaptureSession | None = None
        self._checks: dict[str, BitCheck] = {}

    @property
    def callbacks(self) -> dict[str, Any]:
        """Callbacks with which a session reports its events."""
        return {"on_stored": self.stored, "on_note": self.note, "on_back": self.back, "on_tick": self.tick}

    def run(
        self, session: "CaptureSession", sink: "MeasurementSink", checks: "dict[str, BitCheck]", *, where: str
    ) -> Exception | None:
        """Run a session; return the error that ended it early, or None; an interruption prints where data are."""
        self._session, self._checks = session, checks
        begun_s, cpu_s = time.monotonic(), time.process_time()
        try:
            session.run(sink)
        except (OSError, ValueError) as error:  # stored measurements are sealed in any case
            return error
        except (KeyboardInterrupt, SystemExit):
            click.echo(where, err=True)
            raise
        finally:
            self.took = {"seconds": time.monotonic() - begun_s, "cpu_s": time.process_time() - cpu_s}
            self._line.clear()
        return None

    def stored(self, entries: "list[JournalEntry]") -> None:
        """Report durable measurements."""
        if self._as_json:
            for entry in entries:
                stamp = entry.measurement.stamp
                self._print(
                    {
                        "event": self.word,
                        "sensor": stamp.sensor,
                        "session_id": stamp.session_id,
                        "sequence": stamp.sequence,
                        "sync_count": stamp.sync_count,
                        "timestamp_ns": stamp.timestamp_ns,
                        "uncertainty_ns": stamp.timestamp_uncertainty_ns,
                        "behaviour": stamp.behaviour,
                        "crc32": entry.crc32,
                    }
                )

    def tick(self) -> None:
        """Report that the capture runs, and redraw the progress line when due."""
        _watchdog.beat()
        if self._line.is_drawn and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _REFRESH_S
            self._line.draw(self._progress())

    def note(self, sensor: str, text: str) -> None:
        """Report an event of a sensor."""
        if self._as_json:
            self._print({"event": "note", "sensor": sensor, "text": text})
        self._say(f"{sensor}: {text}")

    def back(self, sensor: str, away_s: float) -> None:
        """Report that an unplugged sensor measures again."""
        if self._as_json:
            self._print({"event": "back", "sensor": sensor, "away_s": round(away_s, 3)})
        self._say(f"{sensor}: reconnected after {away_s:.1f} s")

    def _print(self, event: dict[str, Any]) -> None:
        with self._turn:
            options.print_json(event)

    def _say(self, text: str) -> None:
        options.say(self._line.above(text), quiet=self._quiet)

    def _progress(self) -> str:
        session = self._session
        if session is None:
            return ""
        counts = session.counts.values()
        parts = [
            f"{sum(each.stored for each in counts)} {self.word}",
            " ".join(f"{each.rate_hz:.1f}" for each in counts) + " Hz",
            f"{sum(each.lost for each in counts)} lost",
            *self._more(),
            *(f"{sensor}: {text}" for sensor, text in self._health()),
        ]
        return "   ".join(parts)

    def _more(self) -> Iterator[str]:
        """Yield further parts of the progress line."""
        yield from ()

    def _health(self) -> Iterator[tuple[str, str]]:
        """Yield the number of microphones of each sensor that output both ones and zeros."""
        for sensor, check in self._checks.items():
            density = check.density
            if density is not None:
                alive = int(((density > _ALIVE) & (density < 1 - _ALIVE)).sum())
                yield sensor, f"{alive}/{len(density)} microphones"


def report(
    target: Path | str,
    session: "CaptureSession",
    took: dict[str, float],
    *,
    quiet: bool,
    as_json: bool,
    more: dict[str, Any] | None = None,
    n_lost: int = 0,
) -> None:
    """Report the results of a capture, with more for JSON, and n_lost measurements lost after they were captured."""
    counts = session.counts
    several = len(counts) > 1
    stored, lost = (sum(getattr(each, name) for each in counts.values()) for name in ("stored", "lost"))
    lost += n_lost
    groups = f", {session.complete} complete groups, {session.incomplete} incomplete" if several else ""
    options.say(f"{target}: {options.counted(stored, 'measurement')}, {lost} lost{groups}", quiet=quiet)
    for sensor, each in counts.items():
        for reason, count in each.missing.items():
            options.say(f"{sensor}: {count} missing, {reason}", quiet=quiet)
        if each.skipped:
            options.say(
                f"{sensor}: {options.counted(each.skipped, 'command')} skipped, because the sensor was still busy; set "
                "a lower --rate",
                quiet=quiet,
            )
    if as_json:
        report: dict[str, Any] = {
            sensor: {
                "stored": each.stored,
                "missing": dict(each.missing),
                "unplugged": each.unplugged,
                "skipped": each.skipped,
            }
            for sensor, each in counts.items()
        }
        groups_report = {"complete": session.complete, "incomplete": session.incomplete} if several else None
        options.print_json(
            {"event": "captured", "output": str(target), "stored": stored, "lost": lost, "sensors": report}
            | {name: round(value, 3) for name, value in took.items()}
            | ({"groups": groups_report} if groups_report else {})
            | (more or {})
        )
