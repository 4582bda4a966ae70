"""Seal a journal: make its recording, synchronise it in steps, and remove it."""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Final, TextIO

from msgspec import structs

from ertis_numba.base.atomic_files import temporary_path
from ertis_numba.base.errors import ErtisError, JournalInUseError
from ertis_numba.journal import SUFFIX, SealingResult
from ertis_numba.journal.storage_processes import FromSealing, Sealed, SealingProgress, SealJournal, StorageFailed
from ertis_numba.processes import connect, is_child
from ertis_numba.storage.sealing import PART_TOKEN, seal

__all__ = ["FAILED", "INTERRUPTED", "IN_USE", "NO_MEASUREMENTS", "main"]

FAILED, INTERRUPTED = 1, 130

NO_MEASUREMENTS = 66
"""Exit code for a journal without measurements: EX_NOINPUT of sysexits.h. The journal is removed."""

IN_USE = 75
"""Exit code for a journal that another process has open: EX_TEMPFAIL of sysexits.h, try again later."""

_STEPS = 100  # Number of progress reports.

_NICE: Final = 19  # The lowest priority.
_STEP_BYTES: Final = 4_000_000
_SHRINK_BYTES: Final = 32_000_000
_MAX_PAUSE_S: Final = 0.5


def main(arguments: Sequence[str] | None = None) -> int:
    """Seal a journal and return an exit code: 0 done, `FAILED`, `NO_MEASUREMENTS`, `IN_USE` or `INTERRUPTED`."""
    # The path goes to stdout. With `--json`, it has one object per line: progress, then `SealingResult` or `error`.
    parser = argparse.ArgumentParser(
        "python -m ertis_numba.storage.sealing_process", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("journal", type=Path)
    parser.add_argument("--force", action="store_true", help="replace an existing recording")
    parser.add_argument(
        "--rests", type=float, help="run at low priority, and pause after each step for this multiple of its duration"
    )
    parser.add_argument("--json", action="store_true", help="print progress and result as JSON lines")
    given = parser.parse_args(arguments)
    return _seal(SealJournal(given.journal, given.force, given.rests), _print_json if given.json else _print_text)


def _serve() -> int:
    """Seal the journal that the parent requests; continue if the parent ends."""
    pipe = connect(SealJournal, outlives_parent=True)
    request = next(pipe.messages(), None)
    code = INTERRUPTED if request is None else _seal(request, pipe.send)
    pipe.drain()
    return code


def _seal(request: SealJournal, report: Callable[[FromSealing], None]) -> int:
    recording = request.journal.with_name(request.journal.name.removesuffix(SUFFIX))
    pace = None if request.rests is None else _GradualSync(temporary_path(recording, PART_TOKEN), request.rests)

    def progress(done: int, of: int) -> None:
        if pace is not None:
            pace()
        if done == of or done % max(1, of // _STEPS) == 0:
            report(SealingProgress(done, of))

    try:
        with nullcontext() if request.rests is None else _gradual_unlink(request.journal, request.rests):
            sealed = seal(request.journal, overwrite=request.overwrite, progress=progress)
    except KeyboardInterrupt:
        return INTERRUPTED
    except (ErtisError, OSError, MemoryError) as error:
        line = _printable(" ".join(str(error).split()) or type(error).__name__)
        in_use = isinstance(error, JournalInUseError)
        report(StorageFailed(line, in_use))
        return IN_USE if in_use else FAILED
    report(Sealed(sealed))
    return _exit_code(sealed)


def _exit_code(sealed: SealingResult) -> int:
    if sealed.refused:
        return FAILED
    return NO_MEASUREMENTS if sealed.recording is None else 0


def _print_json(note: FromSealing) -> None:
    fields = asdict(note.result) if isinstance(note, Sealed) else structs.asdict(note)
    values = {name: str(value) if isinstance(value, Path) else value for name, value in fields.items()}
    _write_line(json.dumps(values), sys.stdout)


def _print_text(note: FromSealing) -> None:
    if isinstance(note, StorageFailed):
        _write_line(note.error, sys.stderr)
    elif isinstance(note, Sealed):
        if note.result.recording is not None:
            _write_line(str(note.result.recording), sys.stdout)
        if note.result.remark:
            _write_line(note.result.remark, sys.stderr)


def _write_line(text: str, stream: TextIO) -> None:
    with suppress(OSError):  # The reader may have been killed: the recording is made all the same.
        stream.write(_printable(text) + "\n")
        stream.flush()


def _printable(text: str) -> str:
    """Return text without surrogates, which come from file names that are not valid text."""
    return text.encode(errors="backslashreplace").decode()


class _GradualSync:
    """Gradual sync of a growing file, which need not exist yet, with a pause of ``rests`` times each step's duration.

    A single sync would delay others: a journal's commit then took 370 ms instead of 47 ms.
    """

    def __init__(self, path: Path, rests: float) -> None:
        self._path, self._rests = path, rests
        self._done_bytes = 0
        if hasattr(os, "nice"):
            os.nice(_NICE)

    def __call__(self) -> None:
        """Sync the file if it has grown by one step since the last sync."""
        try:
            n_bytes = self._path.stat().st_size
        except FileNotFoundError:
            return
        if n_bytes - self._done_bytes < _STEP_BYTES:
            return
        begun_s = time.monotonic()
        _sync_data(self._path)
        self._done_bytes = n_bytes
        time.sleep(min(self._rests * (time.monotonic() - begun_s), _MAX_PAUSE_S))


def _sync_data(path: Path) -> None:
    descriptor = os.open(path, os.O_RDWR)
    try:
        getattr(os, "fdatasync", os.fsync)(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _gradual_unlink(path: Path, rests: float) -> Iterator[None]:
    """Truncate a file in steps if the block removes it, because freeing gigabytes at once blocks the disk."""
    if os.name != "posix" or not path.exists():
        yield
        return
    # Closing a file that SQLite has open in this process would release its locks, so this one is closed afterwards.
    descriptor = os.open(path, os.O_RDWR)
    try:
        yield
        while not os.fstat(descriptor).st_nlink and (left := os.fstat(descriptor).st_size):
            os.ftruncate(descriptor, max(0, left - _SHRINK_BYTES))
            begun_s = time.monotonic()
            os.fsync(descriptor)
            time.sleep(min(rests * (time.monotonic() - begun_s), _MAX_PAUSE_S))
    finally:
        os.close(descriptor)


if __name__ == "__main__":
    sys.exit(_serve() if is_child() else main())
