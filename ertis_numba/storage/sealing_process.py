"""Seal a journal: make its recording, and remove it."""

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TextIO

from ertis_numba.atomic_files import temporary_path
from ertis_numba.errors import ErtisError, JournalInUseError
from ertis_numba.journal import SUFFIX, SealingResult
from ertis_numba.storage._gradual_sync import GradualSync, gradual_unlink
from ertis_numba.storage.sealing import PART_TOKEN, seal

__all__ = ["FAILED", "INTERRUPTED", "IN_USE", "NO_MEASUREMENTS", "main"]

FAILED, INTERRUPTED = 1, 130

NO_MEASUREMENTS = 66
"""Exit code for a journal without measurements: EX_NOINPUT of sysexits.h. The journal is removed."""

IN_USE = 75
"""Exit code for a journal that another process has open: EX_TEMPFAIL of sysexits.h, try again later."""

_STEPS = 100  # Number of progress reports.


def main(arguments: Sequence[str] | None = None) -> int:
    """Seal a journal and return an exit code: 0 done, `FAILED`, `NO_MEASUREMENTS`, `IN_USE` or `INTERRUPTED`.

    The path of the recording goes to stdout, and errors go to stderr in one line. With ``--json``, stdout has one
    object per line: progress (``done``, ``of``), and at the end the fields of `SealingResult`, or ``error`` and
    ``in_use``.
    """
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
    recording = given.journal.with_name(given.journal.name.removesuffix(SUFFIX))
    pace = None if given.rests is None else GradualSync(temporary_path(recording, PART_TOKEN), given.rests)

    def progress(done: int, of: int) -> None:
        if pace is not None:
            pace()
        if given.json:
            _report_progress(done, of)

    try:
        with nullcontext() if given.rests is None else gradual_unlink(given.journal, given.rests):
            sealed = seal(given.journal, overwrite=given.force, progress=progress)
    except KeyboardInterrupt:
        return INTERRUPTED
    except (ErtisError, OSError, MemoryError) as error:
        line = " ".join(str(error).split()) or type(error).__name__
        in_use = isinstance(error, JournalInUseError)
        if given.json:
            _emit_event({"error": line, "in_use": in_use})
        else:
            _write_line(line, sys.stderr)
        return IN_USE if in_use else FAILED
    if given.json:
        _emit_event({name: str(value) if isinstance(value, Path) else value for name, value in asdict(sealed).items()})
    else:
        if sealed.recording is not None:
            _write_line(str(sealed.recording), sys.stdout)
        if sealed.remark:
            _write_line(sealed.remark, sys.stderr)
    return _exit_code(sealed)


def _exit_code(sealed: SealingResult) -> int:
    if sealed.refused:
        return FAILED
    return NO_MEASUREMENTS if sealed.recording is None else 0


def _report_progress(done: int, of: int) -> None:
    if done == of or done % max(1, of // _STEPS) == 0:
        _emit_event({"done": done, "of": of})


def _emit_event(report: dict[str, object]) -> None:
    _write_line(json.dumps(report), sys.stdout)


def _write_line(text: str, stream: TextIO) -> None:
    with suppress(OSError):  # The reader may have been killed: the recording is made all the same.
        stream.write(text.encode(errors="backslashreplace").decode() + "\n")  # File names may not be valid text.
        stream.flush()


if __name__ == "__main__":
    sys.exit(main())
