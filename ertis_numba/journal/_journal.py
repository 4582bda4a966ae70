"""Journals: measurements as received, made durable in commits."""

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Self

from ertis_numba.base.atomic_files import fsync
from ertis_numba.base.errors import ArgumentError, DamagedError, DataError
from ertis_numba.journal._contents import SUFFIX
from ertis_numba.journal._database import Database
from ertis_numba.journal._files import (
    LOGS,
    companion,
    disk_errors,
    keep_damaged_log,
    rename_orphans,
    unlink_all,
    unused_path,
)
from ertis_numba.journal._limit import LIMIT, read_limit, write_limit
from ertis_numba.journal._log import WriteAheadLog, read_log
from ertis_numba.journal._recovery import recover_rows
from ertis_numba.journal._rows import WritableJournal
from ertis_numba.journal._tables import VERSION, row_crc32

__all__ = ["SUFFIX", "Journal"]


try:
    import fcntl
except ImportError:  # fcntl does not exist on Windows.
    fcntl = None  # type: ignore[assignment]
_LOCK_BYTES: Final = (0x40000000, 512)  # Lock bytes of SQLite, see https://sqlite.org/lockingv3.html


class Journal(WritableJournal):
    """Durable measurements until they are sealed into the recording ``target``; threads may share it, processes not."""

    def __init__(self, path: Path, database: Database) -> None:
        super().__init__(path, database)
        self.remark = ""

    @property
    def damage(self) -> str:
        """Losses from a damaged log that no gap covers; empty if there are none."""
        return self.tally.damage

    @classmethod
    def create(cls, path: str | Path, *, target: str | Path, source: str = "") -> Self:
        """Create a journal, by convention at ``target`` + `SUFFIX`; a relative target starts at its folder."""
        path = Path(path)
        try:
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        except FileExistsError as error:
            raise ArgumentError(
                f"{path} exists from an interrupted capture; run 'ertis import journals {path}', or choose another name"
            ) from error
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}; choose a writable folder") from error
        try:
            remark = rename_orphans(path)
            made = cls(path, Database(path, empty=True))
            made.remark = remark
            try:
                made._begin(Path(target), source)
            except BaseException:
                made.close()
                raise
        except BaseException:
            unlink_all(path)
            raise
        return made

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open a journal, however its writer ended; raise JournalInUseError, DataError or FormatVersionError."""
        path = Path(path)
        log = read_log(path)
        if log is not None and log.is_truncated:
            choose_log(path, log)
        # A process that is killed just after it created the file leaves it empty or without tables.
        opened = cls(path, Database(path, empty=path.name.endswith(SUFFIX)))
        try:
            is_new = opened._database.is_new
            if is_new:
                opened._begin(Path(path.name.removesuffix(SUFFIX)), "")
            else:
                opened._load()
            opened.tally.read(opened._identity, any_journal=is_new)
            acked = read_limit(path)
            if acked is not None:
                with disk_errors(path):
                    opened.tally.limit(acked)  # Rows above the limit are not a loss.
            damage = recover_rows(opened, opened._database, log)
            if damage:
                opened.tally.note_damage(damage)
            if acked is not None:
                opened._apply_limit(acked)  # This includes rescued rows.
        except BaseException:
            opened.close()
            raise
        return opened

    @staticmethod
    def abandon(path: str | Path, acked: Mapping[tuple[str, int], int]) -> None:
        """Limit a closed journal durably to its ``acked`` numbers by (sensor, session_id); remove it if there are none.

        After a failed sync, a journal may show rows that never reach the disk. Store those that were not acknowledged
        in another journal: the next process that opens this one deletes them first. After an error, call this again.
        """
        path = Path(path)
        if acked:
            write_limit(path, acked)
            return
        unlink_all(path)
        fsync(path.parent)

    def _apply_limit(self, acked: Mapping[tuple[str, int], int]) -> None:
        """Delete rows above the limit."""
        runs = {(key.sensor, key.session_id) for key in self.index()} | {
            (gap.sensor, gap.session_id) for gap in self.gaps
        }
        with self._database.transaction():
            self._database.execute(f"PRAGMA user_version = {VERSION}")  # Row numbers may have holes now.
            for sensor, session_id in sorted(runs):
                above = self._ids[sensor], session_id, acked.get((sensor, session_id), -1)
                self._database.execute(
                    "DELETE FROM measurements WHERE sensor = ? AND epoch = ? AND sequence > ?", above
                )
                self._database.execute("DELETE FROM gaps WHERE sensor = ? AND epoch = ? AND last > ?", above)
        self._last.clear()
        self._n_entries = self._held_bytes = 0
        self._load()
        with disk_errors(self.path):
            companion(self.path, LIMIT).unlink(missing_ok=True)

    def _begin(self, target: Path, source: str) -> None:
        now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        with self._database.transaction():
            self._database.create_tables()
            self._insert("journal", (os.fsencode(target), source, now))
        self._load()
        self.tally.begin(self._identity)

    def restore_header(self, header: Sequence[Any]) -> None:
        """Restore all columns but the first and the last of the table ``journal`` from before its log was damaged."""
        identity = row_crc32(header)
        with self._lock:
            if identity != self._identity:
                with self._database.transaction():
                    self._database.execute("DELETE FROM journal")
                    self._insert("journal", tuple(header))
                self.source, self._identity = header[1], identity
                self.tally.begin(identity)

    def free_log(self) -> None:
        """Move the log to the main file and truncate it to free its space; after a DataError, measurements are safe."""
        with self._lock:
            self._database.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    def remove(self) -> None:
        """Close the journal and remove it: its content is in a recording, or it is empty."""
        with self._lock:
            try:
                with suppress(DataError):
                    self._prepare_rename()
                self.tally.close()
                # If the disk was too full to merge the log, it stays, and has no meaning without the journal.
                unlink_all(self.path)
            finally:
                self.close()
            fsync(self.path.parent)

    def set_aside(self, end: str = "damaged") -> Path:
        """Close the journal, and rename it so that it is never sealed again; after a DataError, it keeps its name."""
        with self._lock:
            try:
                self._prepare_rename()
                aside = unused_path(self.path, end)
                self.tally.remove()
                self.path.rename(aside)
            finally:
                self.close()
            fsync(self.path.parent)
        return aside

    def close(self) -> None:
        """Close the journal; closing twice is harmless."""
        with self._lock:
            is_ours = self._database.has_file
            super().close()
            # Without a log, the main file detects its own damage.
            if is_ours and not self.damage and not any(companion(self.path, end).exists() for end in LOGS):
                with suppress(OSError):
                    self.tally.remove()
            self.tally.close()

    def _prepare_rename(self) -> None:
        """Prepare the file for renaming; it stays locked on systems that allow renaming an open file."""
        if os.name == "nt":
            self.close()
        else:
            self._database.checkpoint_and_remove_log()


def choose_log(path: Path, log: WriteAheadLog) -> None:
    """Replace a damaged log that would damage its journal, and keep a copy of it; after an error, nothing has changed.

    A repaired log replaces it, or none, whichever gives an intact journal; if neither does, raise DamagedError.
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
