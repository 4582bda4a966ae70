"""Log of the operations that reach a file system, written by a library preloaded into the commands."""

import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path
from typing import Final, NamedTuple

from ertis_numba.base.errors import DataError

__all__ = ["DiskOperation", "DiskRecord", "build", "environment", "read"]

_SOURCE: Final = Path(__file__).with_name("disklog.c")
_ENTRY: Final = struct.Struct("=IIQQII")


class DiskOperation(IntEnum):
    """Kinds of records. The numbers are those of ``disklog.c``."""

    CREATE = 1
    WRITE = 2
    TRUNCATE = 3
    SYNC_BEGIN = 4
    SYNC_END = 5
    SYNC_FAIL = 6
    RENAME = 7
    UNLINK = 8
    MKDIR = 9
    RMDIR = 10
    ACK = 11


class DiskRecord(NamedTuple):
    """One event.

    Attributes
    ----------
    kind : DiskOperation
    pid : int
    inode, offset : int
    path : str
    data : bytes
        Written or acknowledged data, or the new name.
    """

    kind: DiskOperation
    pid: int
    inode: int
    offset: int
    path: str
    data: bytes


def build(folder: Path) -> Path:
    """Compile the library into a folder, and return its path.

    Raises
    ------
    DataError
        There is no compiler, or it fails.
    """
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        raise DataError("power cuts need Linux and a C compiler; install gcc")
    library = folder / "disklog.so"
    command = [compiler, "-O2", "-shared", "-fPIC", "-o", str(library), str(_SOURCE), "-ldl"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise DataError(f"{_SOURCE.name} does not compile with {compiler}: {done.stderr.strip()}")
    return library


def environment(
    library: Path, folder: Path, log: Path, *, acks: Path | None = None, fail: tuple[int, int, int] | None = None
) -> dict[str, str]:
    """Return the environment in which a process is logged.

    Parameters
    ----------
    library : Path
    folder : Path
        Folder whose files are logged.
    log : Path
        File that is appended to.
    acks : Path, optional
        File in which the process records acknowledged measurements; its stdout by default.
    fail : (first, count, seed), optional
        Syncs that fail.
    """
    chosen = {
        "LD_PRELOAD": str(library),
        "POWERCUT_FOLDER": str(folder.resolve()),
        "POWERCUT_LOG": str(log),
        "POWERCUT_STDOUT" if acks is None else "POWERCUT_ACKS": "1" if acks is None else str(acks.resolve()),
    }
    if fail is not None:
        chosen["POWERCUT_FAIL"] = " ".join(map(str, fail))
    return os.environ | chosen


def read(log: Path) -> Iterator[DiskRecord]:
    """Yield the complete records of a log. A truncated last record is ignored."""
    content = log.read_bytes()
    place = 0
    while place + _ENTRY.size <= len(content):
        kind, pid, inode, offset, n_path, n_data = _ENTRY.unpack_from(content, place)
        place += _ENTRY.size
        end = place + n_path + n_data
        if end > len(content):
            return
        yield DiskRecord(
            DiskOperation(kind),
            pid,
            inode,
            offset,
            os.fsdecode(content[place : place + n_path]),
            content[place + n_path : end],
        )
        place = end
