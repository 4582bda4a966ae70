"""One SQLite file that belongs to one process, and what SQLite says in the words of this package."""

import os
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from ertis_numba.atomic_files import fsync
from ertis_numba.errors import DamagedError, DataError, FormatVersionError, JournalInUseError
from ertis_numba.journal._files import beside
from ertis_numba.journal._tables import APPLICATION_ID, TABLES, VERSION, layout

__all__ = ["LOG_BYTES", "PAGE_BYTES", "Database"]

PAGE_BYTES: Final = 32_768  # of 4 to 64 KiB, it takes the least time for measurements of 128 KiB to 1 MiB
LOG_BYTES: Final = 4_194_304  # of the write-ahead log; then what is in it moves to the main file
_CACHE_KIB: Final = 4096
_HEADER: Final = struct.Struct(">8s5I")  # of the rollback journal, see https://sqlite.org/fileformat.html
_CHUNK_BYTES: Final = 1_048_576
_MAGIC: Final = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"

_SETUP: Final = (
    "PRAGMA cell_size_check = ON",
    # What a commit wrote has reached the disk when it returns. NORMAL would leave that to the next checkpoint.
    "PRAGMA synchronous = FULL",
    "PRAGMA fullfsync = ON",  # on macOS, where fsync leaves it in the disk's cache
    f"PRAGMA wal_autocheckpoint = {LOG_BYTES // PAGE_BYTES}",
    f"PRAGMA journal_size_limit = {LOG_BYTES}",
    f"PRAGMA cache_size = -{_CACHE_KIB}",
)

_REPORTED: Final = {
    sqlite3.SQLITE_FULL: "has no room on its disk; free some space: what was committed before is safe",
    sqlite3.SQLITE_IOERR: "cannot be written or read ({}); check the disk: what was committed before is safe",
    sqlite3.SQLITE_READONLY: "cannot be written ({}); allow writing to the file and to its folder",
    sqlite3.SQLITE_CANTOPEN: "cannot be opened ({}); allow reading and writing of the file and of its folder",
    sqlite3.SQLITE_PERM: "cannot be opened ({}); allow reading and writing of the file and of its folder",
    sqlite3.SQLITE_CORRUPT: "is damaged ({}); copy it again if you can",
    sqlite3.SQLITE_NOTADB: "is not a journal ({}); give a file that 'ertis capture' left",
}


class Database:
    """An SQLite file with the tables of a journal, which no other process can open meanwhile.

    SQLite holds a lock of the operating system on the file, which ends with the process, however that ends.

    Parameters
    ----------
    path : Path
        It has to exist. An empty file gets its tables, if ``empty`` is set.
    empty : bool

    Attributes
    ----------
    is_new : bool
        It was empty.
    """

    def __init__(self, path: Path, *, empty: bool) -> None:
        self._path = path
        self._writes_once = False  # as far as is known
        self._is_log_named = False  # whether the folder durably has the name of the log that is written
        self._is_folder_synced = True
        self._ends: dict[str, int] = {}  # of the tables before a commit, until it is known to be one
        with self._reported():
            self._file = before = path.stat()
            if not before.st_size and not empty:  # to lock it would make a database of it
                raise DataError(f"{path} is empty; give a journal that 'ertis capture' left")
            for log, least_bytes in _smallest(path):  # SQLite would throw the log away, or make up the rest with zeros
                if before.st_size < least_bytes:
                    raise DamagedError(
                        f"{path} has {before.st_size} bytes, too few to go with its log {log.name}: it was cut short; "
                        "copy both again"
                    )
            uri = f"file:{quote(os.fsencode(path.absolute()))}?mode=rw"
            # Who uses a journal sees to it that two threads do not use it at once.
            self._connection = sqlite3.connect(uri, uri=True, timeout=0, isolation_level=None, check_same_thread=False)
        try:
            with self._reported():
                self.is_new = self._take(before, empty=empty)
        except BaseException:
            self._connection.close()
            self._require_there(before)  # which would explain the error
            raise

    def _take(self, before: os.stat_result, *, empty: bool) -> bool:
        """Lock the file, and make sure of what it is before anything in it changes."""
        self.execute(f"PRAGMA page_size = {PAGE_BYTES}")
        self.execute("PRAGMA locking_mode = EXCLUSIVE")
        self.execute("BEGIN EXCLUSIVE")
        self.execute("COMMIT")
        self._require_there(before)
        self._bring_logs_to_disk()
        ((application,),), ((version,),), ((n_tables,),) = map(
            self.execute, ("PRAGMA application_id", "PRAGMA user_version", "SELECT count(*) FROM sqlite_schema")
        )
        is_new = bool(empty and application == version == n_tables == 0)
        if not is_new and application != APPLICATION_ID:
            raise DataError(f"{self._path} is an SQLite file, but not a journal; give one that 'ertis capture' left")
        if version > VERSION:
            raise FormatVersionError(
                f"{self._path} has format version {version}, this package reads up to {VERSION}; update ertis-numba"
            )
        for statement in _SETUP:
            self.execute(statement)
        if is_new:  # after locking_mode: then its index is in memory, and no -shm is made
            self.execute("PRAGMA journal_mode = WAL")
        return is_new

    def _bring_logs_to_disk(self) -> None:
        """Rewrite the logs of an earlier process in place, and sync them.

        That process may have ended before its sync, or its sync may have failed. The system then marks the failed pages
        as written and never writes them, although readers see their content. Rewriting makes the pages dirty again.
        """
        for log in (beside(self._path, "-wal"), beside(self._path, "-journal")):
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

    def write_once(self) -> None:
        """Have commits write to the main file at once, from now on, and for ever.

        Until then they write to the log, which takes one sync, and move what is in it to the main file when it is full.
        Where each commit fills the log, that is to write all twice. From now on a rollback journal keeps what the pages
        that change were like; new rows take new pages, of which nothing has to be kept. A commit takes four syncs.

        Raises
        ------
        DataError
            The disk is full or fails. All is as before.
        """
        if not self._writes_once:
            self._roll_back_by("DELETE")
            self._writes_once = True
            self._is_folder_synced = self._is_log_named = False  # the old log must not come back, the new one stay

    def _roll_back_by(self, mode: str) -> None:
        """Go over to a rollback journal, which commits leave with a void header, as nobody else can have the file.

        When the file is closed, DELETE removes it by its name.
        """
        if self.execute(f"PRAGMA journal_mode = {mode}") != [(mode.lower(),)]:
            raise DataError(f"{self._path} cannot do without its log; close it, and try again")

    def require_name(self) -> None:
        """Refuse to go on with a file that has lost its name: what is written to it could not be found again.

        Raises
        ------
        InUseError
            It has.
        """
        self._require_there(self._file)

    @property
    def has_name(self) -> bool:
        """Return True if the path still leads to the open file."""
        try:
            self._require_there(self._file)
        except (JournalInUseError, OSError):
            return False
        return True

    def _require_there(self, before: os.stat_result) -> None:
        """Refuse a file that has lost its name: who had locked it may have sealed and removed it."""
        now = self._path.stat() if self._path.exists() else None
        if now is None or (now.st_dev, now.st_ino) != (before.st_dev, before.st_ino):
            raise JournalInUseError(f"{self._path} was removed or replaced by another process; look again")

    def execute(self, statement: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Run a statement and return its rows.

        Raises
        ------
        InUseError
            Another process has the journal.
        DamagedError
            The file is not what was written.
        DataError
            The disk is full, fails or may not be written, the file is closed.
        """
        with self._reported():
            return self._connection.execute(statement, values).fetchall()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Make what happens in the block durable when it ends, all or nothing; when it raises, no row was added."""
        self._sync_folder()
        self._withdraw()
        with self._all_or_nothing():
            self._ends = self._find_ends()
            yield
        if not self._is_log_named:  # the first commit has made the log
            self._is_folder_synced = False
            self._sync_folder()
            self._is_log_named = True
        self._ends = {}

    @contextmanager
    def _all_or_nothing(self) -> Iterator[None]:
        self.execute("BEGIN IMMEDIATE")
        try:
            yield
            self.execute("COMMIT")
        except BaseException:  # Ctrl-C, too
            with suppress(sqlite3.Error):  # the first error is the one to tell
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
            with suppress(DataError):  # the next transaction tries it again
                self._withdraw()
            raise

    def _find_ends(self) -> dict[str, int]:
        """Return the highest number of a row in each table that there is."""
        names = {name for (name,) in self.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}
        tables = [table for table in TABLES if table in names]
        ends = (self.execute(f"SELECT ifnull(max(id), 0) FROM {table}")[0][0] for table in tables)  # noqa: S608  our own
        return dict(zip(tables, ends, strict=True))

    def _withdraw(self) -> None:
        """Delete what a commit has added that failed all the same: in its very last step, when all was written."""
        if ends := self._ends:
            self._ends = {}
            try:
                with self._all_or_nothing():
                    for table, last in ends.items():
                        self.execute(f"DELETE FROM {table} WHERE id > ?", (last,))  # noqa: S608  our own
            except BaseException:
                self._ends = ends
                raise

    def lay_out(self) -> None:
        """Make the tables; to be called in a transaction."""
        for statement in layout():
            self.execute(statement)

    def copy_to(self, path: Path) -> None:
        """Copy the present pages of the file.

        The file is not opened a second time: POSIX releases a lock when the process closes any descriptor of the file.

        Raises
        ------
        DataError
            The disk is full or fails.
        """
        with self._reported():
            copy = sqlite3.connect(path, isolation_level=None)
            try:
                self._connection.backup(copy)
            finally:
                copy.close()

    def leave_log(self) -> None:
        """Bring all to the main file, and remove the log: then closing touches no file by its name.

        Only closing may follow: a commit that is cut off could not be rolled back any more.

        Raises
        ------
        DataError
            The disk is full or fails. The log stays.
        """
        for statement in ("BEGIN IMMEDIATE", "COMMIT"):  # rolls back what a disk that failed has left
            self.execute(statement)
        self._roll_back_by("PERSIST")
        beside(self._path, "-journal").unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; closing twice does no harm."""
        self._connection.close()

    @contextmanager
    def _reported(self) -> Iterator[None]:
        """Tell errors in the words of this package, in a line that names the file."""
        try:
            yield
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", None)
            if code is None:  # what Python's own module has to say
                if "closed" in str(error):
                    raise DataError(f"{self._path} is closed; open it again") from error
                if isinstance(error, sqlite3.ProgrammingError | sqlite3.InterfaceError):
                    raise
                code = sqlite3.SQLITE_CORRUPT
            code &= 0xFF  # without what SQLite adds to a code
            if code in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}:
                raise JournalInUseError(
                    f"{self._path} is in use by another process, a capture or its sealing; wait until that has ended"
                ) from error
            reported = _REPORTED.get(code, "cannot be used ({}); check the disk")
            kind = DamagedError if code == sqlite3.SQLITE_CORRUPT else DataError
            raise kind(f"{self._path} {reported.format(_line(error))}") from error
        except UnicodeError as error:  # from texts that are damaged
            raise DamagedError(f"{self._path} {_REPORTED[sqlite3.SQLITE_CORRUPT].format(_line(error))}") from error
        except OSError as error:
            raise DataError(f"{self._path}: {error.strerror}; give a journal that 'ertis capture' left") from error


def _smallest(path: Path) -> Iterator[tuple[Path, int]]:
    """Yield the logs beside a file, and how long the file has to be for each."""
    log = beside(path, "-wal")
    if log.exists() and log.stat().st_size:
        yield log, PAGE_BYTES
    log = beside(path, "-journal")
    if log.exists():
        with log.open("rb") as file:
            header = file.read(_HEADER.size)
        if len(header) == _HEADER.size and header.startswith(_MAGIC):
            *_, n_pages, _, page_bytes = _HEADER.unpack(header)
            yield log, n_pages * page_bytes


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
