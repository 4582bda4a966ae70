"""Files beside a journal: the logs of SQLite, the tally, the limit, and copies kept as evidence of damage."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from ertis_numba.base.errors import DataError
from ertis_numba.journal._limit import LIMIT
from ertis_numba.journal._tally import TALLY

__all__ = ["LOGS", "companion", "disk_errors", "keep_damaged_log", "rename_orphans", "unlink_all", "unused_path"]

LOGS: Final = ("-wal", "-journal")  # A killed process may leave these files with data.
_COMPANIONS: Final = ("-shm", TALLY, LIMIT)  # Files without use once the journal is removed.


def companion(path: Path, end: str) -> Path:
    """Return the path of a file beside a journal."""
    return path.with_name(f"{path.name}{end}")


def unused_path(path: Path, end: str) -> Path:
    """Return the first of ``NAME.END``, ``NAME.2.END``, ``NAME.3.END``… that does not exist."""
    number, free = 1, companion(path, f".{end}")
    while free.exists():
        number += 1
        free = companion(path, f".{number}.{end}")
    return free


def keep_damaged_log(path: Path, content: bytes) -> Path | None:
    """Keep a copy of a damaged log beside earlier ones; return its path, or None if such a copy exists."""
    log = companion(path, "-wal")
    for kept in log.parent.iterdir():
        if kept.name.startswith(f"{log.name}.") and kept.suffix == ".damaged" and _holds(kept, content):
            return None
    made = unused_path(log, "damaged")
    try:
        with made.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        made.unlink(missing_ok=True)
        raise
    return made


def _holds(path: Path, content: bytes) -> bool:
    return path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content


def unlink_all(path: Path) -> None:
    """Remove a closed journal and the files beside it."""
    for end in ("", *LOGS, *_COMPANIONS):
        companion(path, end).unlink(missing_ok=True)


def rename_orphans(path: Path) -> str:
    """Rename logs of an earlier journal with this name, and return a line about them."""
    for end in _COMPANIONS:
        companion(path, end).unlink(missing_ok=True)
    moved = []
    for log in (companion(path, end) for end in LOGS):
        if log.exists():
            number = 1
            while (aside := companion(log, f".{number}.orphaned")).exists():
                number += 1
            log.rename(aside)
            moved.append(f"{log.name} had no journal and is kept as {aside.name}")
    return "; ".join(moved)


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Raise errors of the system as a `DataError` about a file."""
    try:
        yield
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; check the disk") from error
