"""Sealing: a journal becomes a recording, and goes.

As a process of its own::

    python -m ertis_numba.storage.sealing REC.h5.journal

so that HDF5, which takes its process with it where a disk fails (h5py issue 914), takes nothing else with it. It may
be killed at any moment and run again: the recording is the same.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import ClassVar, TextIO

import numpy as np

from ertis_numba.atomic import part_of, sync
from ertis_numba.errors import DataError, ErtisError, InUseError
from ertis_numba.frames import Measurement
from ertis_numba.journal import SUFFIX, Journal, Sensor
from ertis_numba.storage._journal_rows import JournalRows
from ertis_numba.storage._reader import sensor_names
from ertis_numba.storage.recording import RecordingReader, RecordingWriter, open_recording

__all__ = ["IN_USE", "Sealed", "main", "seal"]

IN_USE = 75
"""Exit code where another process has the journal: EX_TEMPFAIL of sysexits.h, try again later."""

_FAILED, _INTERRUPTED = 1, 130
_TOKEN = "sealing"  # noqa: S105  of the part file: who has the journal is the only one to write it
_STEPS = 100  # in which progress is told

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Sealed:
    """What became of a journal.

    Attributes
    ----------
    journal : Path
    recording : Path or None
        None where nothing had been measured.
    measurements : int
        In the recording.
    missing : int
        Measurements that the recording says to be missing; of those, …
    damaged : int
        … were damaged in the journal.
    set_aside : Path or None
        Where the journal is now, if measurements in it are damaged; it is gone otherwise.
    """

    journal: Path
    recording: Path | None
    measurements: int = 0
    missing: int = 0
    damaged: int = 0
    set_aside: Path | None = None


def seal(path: str | Path, *, overwrite: bool = False, progress: Progress = lambda _done, _of: None) -> Sealed:
    """Make the recording of a journal; when it is complete, verified and on the disk, remove the journal.

    Measurements that are damaged in the journal are gaps of the recording, and the journal is kept under another name.
    What was sealed before is not written again.

    Parameters
    ----------
    path : str or Path
    overwrite : bool
        Replace a file of the recording's name, even if it holds something else.
    progress : callable, optional
        Called with the number of measurements that are written and that of all.

    Raises
    ------
    InUseError
        Another process has the journal.
    DataError
        The journal cannot be read, or the recording not be written, or one of its name holds something else. The
        journal stays.
    ArgumentError
        There can be no file of that name.
    """
    path = Path(path)
    before = path.with_name(path.name.removesuffix(SUFFIX))
    if not path.exists() and before != path and before.is_file():  # killed after the journal went
        return _told(path, before)
    with Journal.open(path) as journal:
        target = journal.target
        part_of(target, _TOKEN).unlink(missing_ok=True)
        if not len(journal):
            journal.remove()
            return Sealed(path, None)
        rows = {name: JournalRows(journal, name) for name in journal.sensors}
        if target.is_file() and _holds(target, journal, rows):
            for place in (target, target.parent):  # who wrote it may have been killed before it did this
                sync(place)
        elif target.is_file() and not overwrite:
            raise DataError(f"{target} exists and holds something else than {path}; move it, or give --force")
        else:
            _write(journal, rows, overwrite=overwrite, progress=progress)
        n_damaged = sum(len(held.damaged) for held in rows.values())
        if n_damaged:
            return _told(path, target, damaged=n_damaged, set_aside=journal.set_aside())
        journal.remove()
    return _told(path, target)


class _Sealer(RecordingWriter):
    _part_token: ClassVar[str | None] = _TOKEN

    def say(self, history: str) -> None:
        """Say what happened to the measurements."""
        self._attributes["history"] = history

    def _require_sensors(self, name: str, given: Iterable[str]) -> None:
        """Take what is known of sensors of which nothing comes: the history tells of them."""


def _write(journal: Journal, rows: dict[str, JournalRows], *, overwrite: bool, progress: Progress) -> None:
    sensors = journal.sensors.values()
    with _Sealer(
        journal.target,
        overwrite=overwrite,
        source=journal.source,
        mounting={sensor.name: (sensor.translation_m, sensor.rotation_xyzw) for sensor in sensors},
        firmware={sensor.name: sensor.firmware for sensor in sensors},
    ) as writer:
        n_written = 0
        for name, held in rows.items():
            for entry in held:
                writer.write(entry.measurement)
                n_written += 1
                progress(n_written, len(journal))
            for gap in held.missing:
                writer.note_gap(name, *gap)
        if not n_written:
            raise DataError(f"{journal.path}: all {len(journal)} measurements are damaged; copy it again if you can")
        writer.say("; ".join(_absent(rows)))


def _absent(rows: dict[str, JournalRows]) -> Iterator[str]:
    """Yield what there is to say of sensors that a recording cannot hold, as it would have no measurement of them."""
    for name, held in rows.items():
        if len(held) == len(held.damaged):
            yield f"sensor {name} has no measurement"
            yield from (f"{first} to {last}: {reason}" for first, last, reason in held.missing)


def _holds(target: Path, journal: Journal, rows: dict[str, JournalRows]) -> bool:
    """Whether a file is the recording of a journal, whole and undamaged."""
    try:
        names = sensor_names(target)
        return set(names) <= set(rows) and all(
            _same(journal.sensors[name], held, open_recording(target, sensor=name))
            if name in names
            else not any(True for _ in held)
            for name, held in rows.items()
        )
    except DataError:
        return False


def _same(sensor: Sensor, rows: JournalRows, recording: RecordingReader) -> bool:
    with recording:
        known = (*recording.translation_m.tolist(), *recording.rotation_xyzw.tolist(), recording.firmware)
        if known != (*sensor.translation_m, *sensor.rotation_xyzw, sensor.firmware) or recording.truth is not None:
            return False
        for entry, back in zip_longest(rows, recording):
            if entry is None or back is None or not _equal(entry.measurement, back):
                return False
        return [(gap.first, gap.last, gap.reason) for gap in recording.gaps] == rows.missing


def _equal(one: Measurement, other: Measurement) -> bool:
    return (one.stamp, one.settings) == (other.stamp, other.settings) and np.array_equal(one.words, other.words)


def _told(path: Path, recording: Path, *, damaged: int = 0, set_aside: Path | None = None) -> Sealed:
    """Return what a recording has come to."""
    n_measurements = n_missing = 0
    for name in sensor_names(recording):
        with open_recording(recording, sensor=name) as reader:
            n_measurements += len(reader)
            n_missing += sum(gap.last - gap.first + 1 for gap in reader.gaps)
    return Sealed(path, recording, n_measurements, n_missing, damaged, set_aside)


def main(arguments: Sequence[str] | None = None) -> int:
    """Seal a journal and return an exit code: 0 done, 1 failed or nothing was measured, `IN_USE`, 130 interrupted.

    The path of the recording goes to stdout, errors in a line to stderr. With ``--json``, stdout has lines of one
    object each: progress (``done``, ``of``), and at last what is in `Sealed`, or ``error`` and ``in_use``.
    """
    parser = argparse.ArgumentParser(
        "python -m ertis_numba.storage.sealing", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("journal", type=Path)
    parser.add_argument("--force", action="store_true", help="replace a file of the recording's name")
    parser.add_argument("--json", action="store_true", help="tell progress and result as lines of JSON")
    given = parser.parse_args(arguments)
    try:
        sealed = seal(given.journal, overwrite=given.force, **({"progress": _tell_progress} if given.json else {}))
    except KeyboardInterrupt:
        return _INTERRUPTED
    except (ErtisError, OSError, MemoryError) as error:
        line = " ".join(str(error).split()) or type(error).__name__
        if given.json:
            _tell({"error": line, "in_use": isinstance(error, InUseError)})
        else:
            _say(line, sys.stderr)
        return IN_USE if isinstance(error, InUseError) else _FAILED
    if given.json:
        _tell({name: str(value) if isinstance(value, Path) else value for name, value in asdict(sealed).items()})
    elif sealed.recording is not None:
        _say(str(sealed.recording), sys.stdout)
    if sealed.recording is None:
        _say(f"{sealed.journal}: no measurement was captured", sys.stderr)
    elif sealed.set_aside is not None:
        number = "1 measurement is" if sealed.damaged == 1 else f"{sealed.damaged} measurements are"
        _say(f"{number} damaged; the journal is kept as {sealed.set_aside}", sys.stderr)
    return _FAILED if sealed.recording is None else 0


def _tell_progress(done: int, of: int) -> None:
    if done == of or done % max(1, of // _STEPS) == 0:
        _tell({"done": done, "of": of})


def _tell(report: dict[str, object]) -> None:
    _say(json.dumps(report), sys.stdout)


def _say(text: str, stream: TextIO) -> None:
    stream.write(text.encode(errors="backslashreplace").decode() + "\n")  # file names may be no text at all
    stream.flush()


if __name__ == "__main__":
    sys.exit(main())
