"""Choice of a log with which a journal with a damaged log can be opened, tried on copies.

SQLite replays a log up to the first damaged frame. If later frames are already in the main file, the replay overwrites
new pages with old ones and damages the main file. Copies are therefore opened first.
"""

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Final

from ertis_numba.base.atomic_files import fsync
from ertis_numba.base.errors import DamagedError, DataError
from ertis_numba.journal._files import companion, keep_damaged_log
from ertis_numba.journal._log import WriteAheadLog

try:
    import fcntl
except ImportError:  # fcntl does not exist on Windows.
    fcntl = None  # type: ignore[assignment]

__all__ = ["choose_log"]

_LOCK_BYTES: Final = (0x40000000, 512)  # Lock bytes of SQLite, see https://sqlite.org/lockingv3.html


def choose_log(path: Path, log: WriteAheadLog) -> None:
    """Replace a damaged log that would damage its journal, and keep a copy of it; after an error, nothing has changed.

    The log stays if the journal is intact with the part that SQLite reads. Otherwise it is replaced by a repaired log,
    which SQLite reads completely, or removed, whichever gives an intact journal; if neither does, raise DamagedError.
    A journal that another process has open is not changed.
    """
    with _locked(path) as is_unused:
        if not is_unused:
            return
        try:
            chosen = _usable_content(path, log)
            if chosen is not log.content:
                _replace_log(path, log.content, chosen)
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}; free space for a copy, because its log is damaged") from error


def _usable_content(path: Path, log: WriteAheadLog) -> bytes:
    """Return the first content of the log with which a copy of the journal is intact."""
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        copy = Path(folder) / path.name
        for content in (log.content, log.repaired, b""):
            shutil.copyfile(path, copy)
            companion(copy, "-wal").write_bytes(content)
            with suppress(sqlite3.Error), closing(sqlite3.connect(copy)) as connection:
                if connection.execute("PRAGMA quick_check(1)").fetchall() == [("ok",)]:
                    return content
            for left in Path(folder).iterdir():
                left.unlink()
    raise DamagedError(f"{path} and its log are damaged; copy both again if you can")


def _replace_log(path: Path, damaged: bytes, chosen: bytes) -> None:
    keep_damaged_log(path, damaged)
    made = companion(path, "-wal.new")
    with made.open("wb") as file:
        file.write(chosen)
        file.flush()
        os.fsync(file.fileno())
    made.replace(companion(path, "-wal"))
    companion(path, "-shm").unlink(missing_ok=True)
    fsync(path.parent)


@contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Lock the journal during the block; yield False if another process has it open."""
    with path.open("r+b") as file:
        if fcntl is not None:
            first, count = _LOCK_BYTES
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, count, first)
            except OSError:
                yield False
                return
        yield True
