"""Many recordings: which are meant, how far they are, and what became of them."""

import glob
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options

if TYPE_CHECKING:
    from rich.progress import TaskID
    from rich.table import Table

    from ertis_numba.campaign import Ended, Event, Wanted

__all__ = ["are_meant", "process_many", "summary"]

_MOST_ROWS = 20  # of a table that has all recordings
_MOST_FAILED = 50  # of them are told again at the end


def are_meant(paths: Sequence[str], target: str | None) -> bool:
    """Whether several recordings may be meant, or a folder for the energyscape files of them."""
    (path, *others) = paths
    return bool(
        others
        or Path(path).is_dir()
        or (glob.has_magic(path) and not Path(path).exists())
        or (target is not None and target.endswith((os.sep, "/")))
    )


def process_many(
    paths: Sequence[str],
    target: str | None,
    wanted: "Wanted",
    *,
    workers: int | None,
    scheduler: str | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Process recordings into a folder, and tell of each how it ended."""
    from ertis_numba.campaign import Campaign, find

    context = click.get_current_context()
    if target is None:
        raise click.UsageError("several recordings need a folder for their energyscapes; give one with -o", context)
    recordings = find(paths)
    campaign = Campaign(recordings, target, wanted, workers=workers, scheduler=scheduler)
    report = _Report([found.path for found in recordings], quiet=quiet, as_json=as_json)
    with closing(campaign.run()) as events, _shown(len(recordings), quiet=quiet) as shown:
        for event in events:
            shown.follow(event)
            report.follow(event, shown)
    report.close()


def summary(target: Path, rows: Sequence[dict[str, Any]], device: str) -> Iterator[str]:
    """Yield a line on what was made of each sensor."""
    for row in rows:
        of = f" of {row['sensor']}" if len(rows) > 1 else ""
        yield (
            f"{target}: {options.counted(row['measurements'], 'measurement')}{of}, "
            f"{options.counted(row['directions'], 'direction')} × {options.counted(row['ranges'], 'range')} "
            f"on {device}, {row['median_ms']:.1f} ms each (median)"
        )


class _Hidden:
    """A progress bar where nobody looks."""

    def follow(self, event: "Event") -> None:
        """Take note of what happens."""

    def say(self, text: str) -> None:
        """Print a line on stderr."""
        click.echo(text, err=True)


class _Bars(_Hidden):
    """A bar over all files, and one over the measurements of each that is under way."""

    def __init__(self, count: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        # stdout is for whoever reads it, even while there are bars on stderr.
        self.progress = Progress(
            *columns, console=Console(file=sys.stderr), redirect_stdout=False, redirect_stderr=False, transient=True
        )
        self._files = self.progress.add_task("recordings", total=count)
        self._tasks: dict[Path, TaskID] = {}

    def follow(self, event: "Event") -> None:
        from rich.markup import escape

        from ertis_numba.campaign import Advanced, Begun

        match event:
            case Begun(recording, measurements):
                self._tasks[recording] = self.progress.add_task(escape(recording.name), total=measurements)
            case Advanced(recording, done):
                if recording in self._tasks:
                    self.progress.update(self._tasks[recording], completed=done)
            case _:
                if (task := self._tasks.pop(event.recording, None)) is not None:
                    self.progress.remove_task(task)
                self.progress.advance(self._files)

    def say(self, text: str) -> None:
        self.progress.console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def _shown(count: int, *, quiet: bool) -> Iterator[_Hidden]:
    if quiet or not sys.stderr.isatty():
        yield _Hidden()
        return
    bars = _Bars(count)
    with bars.progress:
        yield bars


class _Report:
    """What became of the recordings."""

    def __init__(self, recordings: Sequence[Path], *, quiet: bool, as_json: bool) -> None:
        self._count, self._quiet, self._as_json = len(recordings), quiet, as_json
        self._rows: dict[Path, tuple[str, ...]] = dict.fromkeys(recordings[:_MOST_ROWS], ())
        self._begun_s = time.monotonic()
        self._totals = dict.fromkeys(("made", "there", "passed over", "failed"), 0)
        self._measurements = 0
        self._failed: list[str] = []

    def follow(self, event: "Event", shown: _Hidden) -> None:
        """Tell how a recording ended, as soon as it has."""
        from ertis_numba.campaign import Ended

        if not isinstance(event, Ended):
            return
        error = _named(event)
        self._totals[event.outcome] += 1
        self._measurements += event.made.get("measurements", 0)
        for line in _lines(event):
            if not self._quiet:
                shown.say(line)
        for warning in event.made.get("warnings", ()):
            shown.say(f"ertis: warning: {warning}")
        if error:
            shown.say(f"ertis: failed: {error}")
            self._failed.append(str(event.recording))
        if self._count <= _MOST_ROWS:
            self._rows[event.recording] = _row(event)
        if self._as_json:
            options.print_json(_object(event) | ({"error": error} if error else {}))

    def close(self) -> None:
        """Tell how it went on the whole.

        Raises
        ------
        ClickException
            Some recordings failed.
        """
        took_s = time.monotonic() - self._begun_s
        if not self._quiet:
            self._print_table(took_s)
        if self._as_json:
            totals = {name.replace(" ", "_"): count for name, count in self._totals.items()}
            summed = {"measurements": self._measurements, "seconds": round(took_s, 3)}
            options.print_json({"recordings": self._count} | totals | summed)
        if self._failed:
            raise click.ClickException(
                f"{len(self._failed)} of {options.counted(self._count, 'recording')} failed; mend what is told above "
                "and process again: what is made stays"
            )

    def _print_table(self, took_s: float) -> None:
        from rich.console import Console

        console = Console(file=sys.stderr, width=None if sys.stderr.isatty() else 160)
        if self._count <= _MOST_ROWS:
            console.print(_table([*self._rows.values()]))
        elif self._failed:
            rows = [(path, "failed", "", "") for path in self._failed[:_MOST_FAILED]]
            more = len(self._failed) - len(rows)
            console.print(_table(rows + ([(f"… and {more} more", "failed", "", "")] if more else [])))
        counts = ", ".join(f"{count} {name}" for name, count in self._totals.items() if count)
        done = options.counted(self._measurements, "measurement")
        text = f"{options.counted(self._count, 'recording')}: {counts}; {done} in {took_s:.1f} s"
        console.print(text, markup=False, highlight=False, soft_wrap=True)


def _named(event: "Ended") -> str:
    """Return why a recording failed, with its name."""
    if not event.error or str(event.recording) in event.error:
        return event.error
    return f"{event.recording}: {event.error}"


def _lines(event: "Ended") -> Iterator[str]:
    match event.outcome:
        case "made":
            rows = event.made["sensors"]
            yield from (line for row in rows for line in row.pop("lines", ()))
            yield from summary(event.output, rows, event.made["device"])
        case "there":
            yield f"{event.output}: made before"
        case "passed over":
            yield f"{event.recording}: is no recording but an energyscape file, passed over"


def _object(event: "Ended") -> dict[str, Any]:
    """Return what became of a recording as ``--json`` has it."""
    told = {"recording": str(event.recording), "output": str(event.output), "outcome": event.outcome}
    return told | {name: value for name, value in event.made.items() if name != "warnings"}


def _row(event: "Ended") -> tuple[str, ...]:
    made = event.made
    figures = (f"{made['measurements']}", f"{made['median_ms']:.1f}") if made else ("", "")
    return (str(event.recording), event.outcome, *figures)


def _table(rows: Sequence[tuple[str, ...]]) -> "Table":
    from rich.box import SIMPLE
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=SIMPLE, pad_edge=False)
    for heading, justify in (("recording", "left"), ("outcome", "left"), ("measurements", "right"), ("ms", "right")):
        table.add_column(heading, justify="right" if justify == "right" else "left")
    for row in rows:
        table.add_row(*map(escape, row), style="red" if row[1] == "failed" else None)
    return table
