"""Choice of the log that a journal with a damaged log is opened with, made on copies.

SQLite replays a log up to the first damaged frame. If later frames had been moved to the main file already, that
puts old pages over new ones and ruins the main file. So copies are opened first.
"""

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Final

from ertis_numba.atomic_files import fsync
from ertis_numba.errors import DamagedError, DataError
from ertis_numba.journal._files import beside, keep_damaged_log
from ertis_numba.journal._log import WriteAheadLog

try:
    import fcntl
except ImportError:  # fcntl does not exist on Windows.
    fcntl = None  # type: ignore[assignment]

__all__ = ["choose_log"]

_LOCK_BYTES: Final = (0x40000000, 512)  # Lock bytes of SQLite, see https://sqlite.org/lockingv3.html


def choose_log(path: Path, log: WriteAheadLog) -> None:
    """Replace a damaged log that would ruin its journal, and keep the damaged one beside it.

    The log stays if the journal is sound with the part that SQLite reads. Otherwise the log is repaired, so that all
    of it is read, or taken away, whichever leaves a sound journal. A journal that another process uses is left alone.

    Parameters
    ----------
    path : Path
        Of the journal.
    log : Log
        As it is on the disk.

    Raises
    ------
    DamagedError
        The journal is sound with neither. Nothing has changed.
    DataError
        The disk is full or fails. Nothing has changed.
    """
    with _unused(path) as is_unused:
        if not is_unused:
            return
        try:
            chosen = _sound(path, log)
            if chosen is not log.content:
                _install(path, log.content, chosen)
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}; make room for a copy of it, as its log is damaged") from error


def _sound(path: Path, log: WriteAheadLog) -> bytes:
    """Return the first content of the log with which a copy of the journal is sound."""
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        copy = Path(folder) / path.name
        for content in (log.content, log.repaired, b""):
            shutil.copyfile(path, copy)
            beside(copy, "-wal").write_bytes(content)
            with suppress(sqlite3.Error), closing(sqlite3.connect(copy)) as connection:
                if connection.execute("PRAGMA quick_check(1)").fetchall() == [("ok",)]:
                    return content
            for left in Path(folder).iterdir():
                left.unlink()
    raise DamagedError(f"{path} and its log are damaged; copy both again if you can")


def _install(path: Path, damaged: bytes, chosen: bytes) -> None:
    keep_damaged_log(path, damaged)
    made = beside(path, "-wal.new")
    with made.open("wb") as file:
        file.write(chosen)
        file.flush()
        os.fsync(file.fileno())
    made.replace(beside(path, "-wal"))
    beside(path, "-shm").unlink(missing_ok=True)
    fsync(path.parent)


@contextmanager
def _unused(path: Path) -> Iterator[bool]:
    """Yield whether no other process has the journal open, and keep others out meanwhile."""
    with path.open("r+b") as file:
        if fcntl is not None:
            first, count = _LOCK_BYTES
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, count, first)
            except OSError:
                yield False
                return
        yield True
