"""Processing of many recordings: selection, progress and report."""

import glob
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _naming, _plans, _progress, _tables, options
from ertis_cli._config import typed

if TYPE_CHECKING:
    from rich.progress import TaskID

    from ertis_numba.campaign import CampaignOptions, Event, RecordingEnded

__all__ = ["are_meant", "process_many", "processing", "require_options_of_one", "summary"]

_MAX_ROWS = 20  # limit for a table of all recordings
_WAVEFRONT = ("wavefront_error_db", "wavefront_error_range_m")
_MAX_FAILED = 50  # limit for failed recordings in the final table


def processing(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options for processing one or several recordings: checks, device and processes."""
    for option in (
        options.workers(" for several recordings"),
        options.threads,
        options.device,
        click.option("--strict", is_flag=True, help="Refuse recordings with faulty microphones instead of warning."),
    ):
        command = option(command)
    return command


def require_options_of_one() -> None:
    """Refuse options for several recordings."""
    if typed("workers"):
        raise click.UsageError(
            "--workers applies to several recordings; add recordings, use a folder or a pattern, or end -o with /",
            click.get_current_context(),
        )


def are_meant(paths: Sequence[str], target: str | None) -> bool:
    """Return True if the paths may name several recordings, or the target is a folder."""
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
    wanted: "CampaignOptions",
    *,
    workers: int | str | None,
    quiet: bool,
    as_json: bool,
) -> None:
    """Process recordings into a folder, and report the outcome of each."""
    from ertis_numba.campaign import Campaign, find_recordings

    context = click.get_current_context()
    if target is None:
        raise click.UsageError("several recordings need an output folder; choose one with -o", context)
    if Path(target).suffix and not target.endswith((os.sep, "/")) and not Path(target).is_dir():
        raise click.UsageError(
            f"-o {target} names a file, but several recordings need a folder; use -o {Path(target).with_suffix('')}/",
            context,
        )
    recordings = find_recordings(paths)
    campaign = Campaign(recordings, target, wanted, workers=workers)
    report = _Report([found.path for found in recordings], quiet=quiet, as_json=as_json)
    with closing(campaign.run()) as events, _shown(len(recordings), quiet=quiet) as shown:
        for event in events:
            shown.follow(event)
            report.follow(event, shown)
    report.close()


def summary(target: Path, report: dict[str, Any]) -> Iterator[str]:
    """Yield a line with the images or maps of each sensor, from the report of a recording."""
    for row in report["sensors"]:
        of = f" of {row['sensor']}" if len(report["sensors"]) > 1 else ""
        made = ""
        if "maps" in row:
            made = f"{options.counted(row['maps'], 'acoustic map')} of "
            axis = options.counted(row["bands"], "band")
        else:
            axis = (
                f"{options.counted(row['ranges'], 'range')} from {row['range_m'][0]:.4g} to {row['range_m'][1]:.4g} m"
            )
        yield (
            f"{target}: {made}{options.counted(row['measurements'], 'measurement')}{of}, "
            f"{options.counted(row['directions'], 'direction')} × {axis} on {report['device']}, "
            f"{row['median_ms']:.1f} ms each (median)"
        )


class _Hidden:
    """Placeholder for progress bars that are not drawn."""

    def follow(self, event: "Event") -> None:
        """Handle an event of the campaign."""

    def say(self, text: str) -> None:
        """Print a line on stderr."""
        click.echo(text, err=True)


class _Bars(_Hidden):
    """Progress bars: one over all files, and one over the measurements of each current recording."""

    def __init__(self, count: int) -> None:
        self.progress = _progress.bars()
        self._files = self.progress.add_task("recordings", total=count)
        self._tasks: dict[Path, TaskID] = {}

    def follow(self, event: "Event") -> None:
        from ertis_numba.campaign import RecordingProgress, RecordingStarted

        match event:
            case RecordingStarted(recording, measurements):
                self._tasks[recording] = self.progress.add_task(recording.name, total=measurements)
            case RecordingProgress(recording, done):
                if recording in self._tasks:
                    self.progress.update(self._tasks[recording], completed=done)
            case _:
                if (task := self._tasks.pop(event.recording, None)) is not None:
                    self.progress.remove_task(task)
                self.progress.advance(self._files)


@contextmanager
def _shown(count: int, *, quiet: bool) -> Iterator[_Hidden]:
    if quiet or not _progress.is_drawn_on(sys.stderr):
        yield _Hidden()
        return
    bars = _Bars(count)
    with _progress.drawn(bars.progress):
        yield bars


class _Report:
    """Reporter of the outcome of recordings."""

    def __init__(self, recordings: Sequence[Path], *, quiet: bool, as_json: bool) -> None:
        self._count, self._quiet, self._as_json = len(recordings), quiet, as_json
        self._rows: dict[Path, tuple[str, ...]] = dict.fromkeys(recordings[:_MAX_ROWS], ())
        self._begun_s = time.monotonic()
        self._totals = dict.fromkeys(("made", "kept", "skipped", "failed"), 0)
        self._measurements = 0
        self._wavefronts: list[tuple[float, float]] = []  # error in dB and its range in metres, of each recording
        self._failed: list[str] = []

    def follow(self, event: "Event", shown: _Hidden) -> None:
        """Report the outcome of a recording as soon as it ends."""
        from ertis_numba.campaign import RecordingEnded

        if not isinstance(event, RecordingEnded):
            return
        error = _naming.with_options(_named(event))
        self._totals[event.outcome] += 1
        self._measurements += event.made.get("measurements", 0)
        found = [_plane_error(row) for row in event.made.get("sensors", ())]
        self._wavefronts += sorted(filter(None, found))[-1:]
        for line in _lines(event, reported=not self._as_json):
            if not self._quiet:
                shown.say(line)
        for warning in event.made.get("warnings", ()):
            shown.say(f"ertis: warning: {_naming.with_options(warning)}")
        if error:
            shown.say(f"ertis: failed: {error}")
            self._failed.append(str(event.recording))
        if self._count <= _MAX_ROWS:
            self._rows[event.recording] = _row(event)
        if self._as_json:
            options.print_json(_object(event) | ({"error": error} if error else {}))

    def close(self) -> None:
        """Report the totals; raise ClickException if some recordings failed."""
        took_s = time.monotonic() - self._begun_s
        if not self._quiet:
            self._print_wavefronts()
            self._print_table(took_s)
        if self._as_json:
            totals = {name.replace(" ", "_"): count for name, count in self._totals.items()}
            summed = {"measurements": self._measurements, "seconds": round(took_s, 3)}
            options.print_json({"recordings": self._count} | totals | summed)
        if self._failed:
            raise click.ClickException(
                f"{len(self._failed)} of {options.counted(self._count, 'recording')} failed; fix the errors above "
                "and process again: finished recordings are kept"
            )

    def _print_wavefronts(self) -> None:
        if self._wavefronts and not self._as_json:
            whose = f"{len(self._wavefronts)} of {options.counted(self._count, 'recording')}"
            click.echo(_plans.wavefront_note(whose, *max(self._wavefronts)), err=True)

    def _print_table(self, took_s: float) -> None:
        if self._count <= _MAX_ROWS:
            _table([row for row in self._rows.values() if row]).print(err=True)
        elif self._failed:
            rows = [(path, "failed", "", "") for path in self._failed[:_MAX_FAILED]]
            more = len(self._failed) - len(rows)
            _table(rows + ([(f"… and {more} more", "failed", "", "")] if more else [])).print(err=True)
        counts = ", ".join(f"{count} {name}" for name, count in self._totals.items() if count)
        done = options.counted(self._measurements, "measurement")
        click.echo(f"{options.counted(self._count, 'recording')}: {counts}; {done} in {took_s:.1f} s", err=True)


def _named(event: "RecordingEnded") -> str:
    """Return the error of a recording with the name of the recording, and with options as the user types them."""
    before, context = f"{event.recording}: ", click.get_current_context(silent=True)
    error = event.error.removeprefix(before)
    if not error or str(event.recording) in error:
        return event.error
    return before + (error if context is None else _naming.named(error, context))


def _lines(event: "RecordingEnded", *, reported: bool) -> Iterator[str]:
    """Yield the lines about a recording; plans are left out if JSON contains them."""
    match event.outcome:
        case "made":
            yield from _plan_lines(event, reported=reported)
            yield from summary(event.output, event.made)
        case "kept":
            yield from _plan_lines(event, reported=reported)
            yield f"{event.output}: exists already, kept"
        case "skipped" if not event.made:  # Otherwise, a warning has the reason.
            yield f"{event.recording}: a result of processing, not a recording; skipped"


def _plan_lines(event: "RecordingEnded", *, reported: bool) -> Iterator[str]:
    for row in event.made.get("sensors", ()):
        if reported:
            kept = row if "plan" in row else {name: value for name, value in row.items() if name not in _WAVEFRONT}
            yield from _plans.report_lines(row["sensor"], kept)


def _plane_error(row: dict[str, Any]) -> tuple[float, float] | None:
    """Return the error of plane wavefronts and its range, unless the report contains a plan."""
    if "plan" in row or _WAVEFRONT[0] not in row:
        return None
    return row[_WAVEFRONT[0]], row[_WAVEFRONT[1]]


def _object(event: "RecordingEnded") -> dict[str, Any]:
    """Return the JSON object of a recording."""
    reported = {"recording": str(event.recording), "output": str(event.output), "outcome": event.outcome}
    return reported | {name: value for name, value in event.made.items() if name != "warnings"}


def _row(event: "RecordingEnded") -> tuple[str, ...]:
    made = event.made
    figures = (f"{made['measurements']}", f"{made['median_ms']:.1f}") if "median_ms" in made else ("", "")
    return (str(event.recording), event.outcome, *figures)


def _table(rows: Sequence[tuple[str, ...]]) -> _tables.TextTable:
    columns: dict[str, _tables.Side] = {"recording": "left", "outcome": "left", "measurements": "right", "ms": "right"}
    return _tables.TextTable(columns, rows, {"failed": "red"})
