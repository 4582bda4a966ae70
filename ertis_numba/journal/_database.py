"""SQLite file for exclusive use by one process, with errors in the form of this package."""

import os
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from ertis_numba.base.atomic_files import fsync
from ertis_numba.base.errors import DamagedError, DataError, FormatVersionError, JournalInUseError
from ertis_numba.journal._files import companion
from ertis_numba.journal._tables import (
    APPLICATION_ID,
    COMPLETE_VERSION,
    TABLES,
    VERSION,
    create_statements,
    upgrade_statements,
)

__all__ = ["LOG_BYTES", "PAGE_BYTES", "Database"]

PAGE_BYTES: Final = 32_768  # Among 4 to 64 KiB, the fastest for measurements of 128 KiB to 1 MiB.
LOG_BYTES: Final = 4_194_304  # Size of the write-ahead log at which its content moves to the main file.
_CACHE_KIB: Final = 4096
_HEADER: Final = struct.Struct(">8s5I")  # Header of the rollback journal, see https://sqlite.org/fileformat.html
_CHUNK_BYTES: Final = 1_048_576
_MAGIC: Final = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"

_SETUP: Final = (
    "PRAGMA cell_size_check = ON",
    # A commit is on disk when it returns. NORMAL would leave that to the next checkpoint.
    "PRAGMA synchronous = FULL",
    "PRAGMA fullfsync = ON",  # On macOS, fsync alone leaves data in the disk's cache.
    f"PRAGMA wal_autocheckpoint = {LOG_BYTES // PAGE_BYTES}",
    f"PRAGMA journal_size_limit = {LOG_BYTES}",
    f"PRAGMA cache_size = -{_CACHE_KIB}",
)

_MESSAGES: Final = {
    sqlite3.SQLITE_FULL: "has no room on its disk; free some space: what was committed before is safe",
    sqlite3.SQLITE_IOERR: "cannot be written or read ({}); check the disk: what was committed before is safe",
    sqlite3.SQLITE_READONLY: "cannot be written ({}); allow writing to the file and to its folder",
    sqlite3.SQLITE_CANTOPEN: "cannot be opened ({}); allow reading and writing of the file and of its folder",
    sqlite3.SQLITE_PERM: "cannot be opened ({}); allow reading and writing of the file and of its folder",
    sqlite3.SQLITE_CORRUPT: "is damaged ({}); copy it again if you can",
    sqlite3.SQLITE_NOTADB: "is not a journal ({}); choose a file that 'ertis capture' left",
}


class Database:
    """SQLite file with the tables of a journal, locked by this process; an ``empty`` file becomes a new journal."""

    def __init__(self, path: Path, *, empty: bool) -> None:
        self._path = path
        self._uses_rollback_journal = False  # An existing file may already use a rollback journal.
        self._is_log_durable = False  # True once the folder durably contains the name of the log.
        self._is_folder_synced = True
        self._uncommitted_max_ids: dict[str, int] = {}  # Highest row numbers before a commit whose result is unknown.
        with self._translate_errors():
            self._file = before = path.stat()
            if not before.st_size and not empty:  # Locking would turn it into a database.
                raise DataError(f"{path} is empty; choose a journal left by 'ertis capture'")
            for log, least_bytes in _min_sizes(path):  # SQLite would discard the log, or pad with zeros.
                if before.st_size < least_bytes:
                    raise DamagedError(
                        f"{path} has {before.st_size} bytes, but its log {log.name} needs at least {least_bytes}: "
                        "it was truncated; copy both again"
                    )
            uri = f"file:{quote(os.fsencode(path.absolute()))}?mode=rw"
            # Callers ensure that only one thread uses a journal at a time.
            self._connection = sqlite3.connect(uri, uri=True, timeout=0, isolation_level=None, check_same_thread=False)
        try:
            with self._translate_errors():
                self.is_new = self._lock_and_check(before, empty=empty)
        except BaseException:
            self._connection.close()
            self._require_same_file(before)  # A missing file would explain the error.
            raise

    def _lock_and_check(self, before: os.stat_result, *, empty: bool) -> bool:
        """Lock the file, and check its format before anything in it changes; return True for a new journal."""
        self.execute(f"PRAGMA page_size = {PAGE_BYTES}")
        self.execute("PRAGMA locking_mode = EXCLUSIVE")
        self.execute("BEGIN EXCLUSIVE")
        self.execute("COMMIT")
        self._require_same_file(before)
        self._sync_logs()
        ((application,),), ((version,),), ((n_tables,),) = map(
            self.execute, ("PRAGMA application_id", "PRAGMA user_version", "SELECT count(*) FROM sqlite_schema")
        )
        is_new = bool(empty and application == version == n_tables == 0)
        if not is_new and application != APPLICATION_ID:
            raise DataError(
                f"{self._path} is an SQLite file, but not a journal; choose a journal left by 'ertis capture'"
            )
        if version > VERSION:
            raise FormatVersionError(
                f"{self._path} has format version {version}, but this package reads up to {VERSION}; update ertis-numba"
            )
        for statement in _SETUP:
            self.execute(statement)
        if 0 < version < COMPLETE_VERSION:
            for statement in upgrade_statements(version):
                self.execute(statement)
        if is_new:  # After locking_mode, the log's index is in memory, and no -shm file is created.
            self.execute("PRAGMA journal_mode = WAL")
        return is_new

    def _sync_logs(self) -> None:
        """Rewrite the logs of an earlier process in place, and sync them.

        That process may have ended before its sync, or its sync may have failed. The system then marks the failed pages
        as written and never writes them, although readers see their content. Rewriting makes the pages dirty again.
        """
        for log in (companion(self._path, "-wal"), companion(self._path, "-journal")):
            if log.exists() and log.stat().st_size:
                with log.open("r+b", buffering=0) as file:
                    while chunk := file.read(_CHUNK_BYTES):
                        file.seek(-len(chunk), os.SEEK_CUR)
                        file.write(chunk)
                    os.fsync(file.fileno())
                self._is_folder_synced = False
        self._sync_folder()

    def _sync_folder(self) -> None:
        """Make the names of the logs durable; SQLite also syncs the folder, but ignores an error of that sync."""
        if self._is_folder_synced:
            return
        try:
            fsync(self._path.parent)
        except OSError as error:
            raise DataError(
                f"{self._path.parent}: {error.strerror}; check the disk: what was committed before is safe"
            ) from error
        self._is_folder_synced = True

    def use_rollback_journal(self) -> None:
        """Switch to a rollback journal permanently, so that commits write to the main file at once."""
        # A full log writes all data twice with one sync; a rollback journal stores only old content, but needs four
        # syncs.
        if not self._uses_rollback_journal:
            self._set_rollback_mode("DELETE")
            self._uses_rollback_journal = True
            # The old log must not reappear, and the new one must stay.
            self._is_folder_synced = self._is_log_durable = False

    def _set_rollback_mode(self, mode: str) -> None:
        """Switch to a rollback journal."""
        # A commit invalidates its header instead of removing it, because no other process can open the file.
        if self.execute(f"PRAGMA journal_mode = {mode}") != [(mode.lower(),)]:
            raise DataError(f"{self._path} cannot switch from its log; close it, and try again")

    def require_file(self) -> None:
        """Refuse to continue if the path no longer leads to the open file, because new data would be lost."""
        self._require_same_file(self._file)

    @property
    def has_file(self) -> bool:
        """Return True if the path still leads to the open file."""
        try:
            self._require_same_file(self._file)
        except (JournalInUseError, OSError):
            return False
        return True

    def _require_same_file(self, before: os.stat_result) -> None:
        """Refuse a removed or replaced file: the process that had locked it may have sealed it."""
        now = self._path.stat() if self._path.exists() else None
        if now is None or (now.st_dev, now.st_ino) != (before.st_dev, before.st_ino):
            raise JournalInUseError(f"{self._path} was removed or replaced by another process; check the folder again")

    def has_table(self, name: str) -> bool:
        """Return True if a table exists."""
        return bool(self.execute("SELECT 1 FROM sqlite_schema WHERE type = 'table' AND name = ?", (name,)))

    def execute(self, statement: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Run a statement and return its rows; raise JournalInUseError, DamagedError, or DataError."""
        with self._translate_errors():
            return self._connection.execute(statement, values).fetchall()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Make the changes of the block durable at its end, all or none; an error adds no row."""
        self._sync_folder()
        self._delete_uncommitted()
        with self._atomic():
            self._uncommitted_max_ids = self.max_ids()
            yield
        if not self._is_log_durable:  # The first commit has created the log.
            self._is_folder_synced = False
            self._sync_folder()
            self._is_log_durable = True
        self._uncommitted_max_ids = {}

    @contextmanager
    def _atomic(self) -> Iterator[None]:
        self.execute("BEGIN IMMEDIATE")
        try:
            yield
            self.execute("COMMIT")
        except BaseException:  # This includes Ctrl-C.
            with suppress(sqlite3.Error):  # The first error is the one to report.
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
            with suppress(DataError):  # The next transaction tries it again.
                self._delete_uncommitted()
            raise

    def max_ids(self) -> dict[str, int]:
        """Return the highest row number of each table, 0 if it has no rows."""
        tables = [table for table in TABLES if self.has_table(table)]
        ends = (self.execute(f"SELECT ifnull(max(id), 0) FROM {table}")[0][0] for table in tables)  # noqa: S608  our own
        return dict(zip(tables, ends, strict=True))

    def _delete_uncommitted(self) -> None:
        """Delete the rows of a failed commit, whose last step may fail after all rows were written."""
        if ends := self._uncommitted_max_ids:
            self._uncommitted_max_ids = {}
            try:
                with self._atomic():
                    for table, last in ends.items():
                        self.execute(f"DELETE FROM {table} WHERE id > ?", (last,))  # noqa: S608  our own
            except BaseException:
                self._uncommitted_max_ids = ends
                raise

    def create_tables(self) -> None:
        """Create the tables, within a transaction."""
        for statement in create_statements():
            self.execute(statement)

    def copy_to(self, path: Path) -> None:
        """Copy the current pages by the open connection: closing a second descriptor would release the lock (POSIX)."""
        with self._translate_errors():
            copy = sqlite3.connect(path, isolation_level=None)
            try:
                self._connection.backup(copy)
            finally:
                copy.close()

    def checkpoint_and_remove_log(self) -> None:
        """Move everything to the main file and remove the log, so that closing touches no file by name."""
        # Only `close` may follow, because an interrupted commit could no longer be rolled back.
        for statement in ("BEGIN IMMEDIATE", "COMMIT"):  # They roll back a commit that a disk error has interrupted.
            self.execute(statement)
        self._set_rollback_mode("PERSIST")
        companion(self._path, "-journal").unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; closing twice is harmless."""
        self._connection.close()

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """Raise errors of SQLite as errors of this package, in one line with the name of the file."""
        try:
            yield
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", None)
            if code is None:  # Errors of the Python module have no code.
                if "closed" in str(error):
                    raise DataError(f"{self._path} is closed; open it again") from error
                if isinstance(error, sqlite3.ProgrammingError | sqlite3.InterfaceError):
                    raise
                code = sqlite3.SQLITE_CORRUPT
            code &= 0xFF  # Extended codes add further bits.
            if code in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
                raise JournalInUseError(
                    f"{self._path} is in use by another process, a capture or its sealing; wait until that has ended"
                ) from error
            reported = _MESSAGES.get(code, "cannot be used ({}); check the disk")
            kind = DamagedError if code == sqlite3.SQLITE_CORRUPT else DataError
            raise kind(f"{self._path} {reported.format(_one_line(error))}") from error
        except UnicodeError as error:  # Damaged text raises this error.
            raise DamagedError(f"{self._path} {_MESSAGES[sqlite3.SQLITE_CORRUPT].format(_one_line(error))}") from error
        except OSError as error:
            raise DataError(f"{self._path}: {error.strerror}; choose a journal left by 'ertis capture'") from error


def _min_sizes(path: Path) -> Iterator[tuple[Path, int]]:
    """Yield the logs beside a file, and the minimum length of the file for each."""
    log = companion(path, "-wal")
    if log.exists() and log.stat().st_size:
        yield log, PAGE_BYTES
    log = companion(path, "-journal")
    if log.exists():
        with log.open("rb") as file:
            header = file.read(_HEADER.size)
        if len(header) == _HEADER.size and header.startswith(_MAGIC):
            *_, n_pages, _, page_bytes = _HEADER.unpack(header)
            yield log, n_pages * page_bytes


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
