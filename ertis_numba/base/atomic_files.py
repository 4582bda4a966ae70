"""Atomic writing of files: a file appears under its name complete or not at all."""

import errno
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ertis_numba.base.errors import ArgumentError, DataError

__all__ = [
    "RESERVED_BYTES",
    "atomic_write",
    "check_target",
    "fsync",
    "make_folder",
    "reason",
    "remedy",
    "require_free_space",
    "require_writable",
    "temporary_path",
]

# HDF5 can crash the process if the disk becomes full while it closes a file (h5py issue 914). Writing therefore stops
# while there is still room for its tables.
RESERVED_BYTES = 8_000_000

_FREE_SPACE_REMEDY = "free some space or write elsewhere"
_PERMISSION_REMEDY = "check the permissions of the file and its folder, or choose another"
_MISSING_FOLDER_REMEDY = "check that its folder exists, or choose another"
_REMEDIES = {
    errno.EACCES: _PERMISSION_REMEDY,
    errno.EPERM: _PERMISSION_REMEDY,
    errno.EROFS: _PERMISSION_REMEDY,
    errno.ENOENT: _MISSING_FOLDER_REMEDY,
    errno.ENOTDIR: _MISSING_FOLDER_REMEDY,
    errno.ENAMETOOLONG: "use a shorter name",
    errno.EDQUOT: _FREE_SPACE_REMEDY,
    errno.EFBIG: _FREE_SPACE_REMEDY,
    errno.ENOSPC: _FREE_SPACE_REMEDY,
}


def check_target(path: Path, *, overwrite: bool, sources: Iterable[Path] = ()) -> None:
    """Refuse a path that cannot be written, is one of the input files ``sources``, or exists without ``overwrite``."""
    if path.is_dir():
        raise ArgumentError(f"output {path} is a folder; choose the name of a file")
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise ArgumentError(f"output {path} is a link or a device; choose the name of a file")
    if not path.parent.is_dir():
        raise ArgumentError(f"output {path}: folder {path.parent} does not exist; create it or choose another")
    if path.exists() and any(source.exists() and source.samefile(path) for source in sources):
        raise ArgumentError(f"output {path} is the input itself; choose another name")
    if path.exists() and not overwrite:
        raise ArgumentError(f"output {path} exists; choose another name, or replace the file (overwrite=True)")


def require_writable(folder: Path) -> None:
    """Create a file in a folder and remove it; raise OSError if that fails."""
    with tempfile.TemporaryFile(dir=folder):
        pass


def reason(error: Exception) -> str:
    """Return the message of the operating system, which HDF5 has within its own, or else the first line of an error."""
    inner = re.search(r"error message = '(.*?)'", str(error))
    return inner[1] if inner else getattr(error, "strerror", None) or str(error).partition("\n")[0]


def remedy(error: Exception) -> str:
    """Return advice for an error of the operating system; HDF5 has the error number within its message."""
    inner = re.search(r"errno = (\d+)", str(error))
    number = int(inner[1]) if inner else getattr(error, "errno", None)
    return _REMEDIES.get(number or 0, "check the disk, or write elsewhere")


def require_free_space(folder: Path, n_bytes: int, *, purpose: str = "the next data") -> None:
    """Raise DataError if less than `RESERVED_BYTES` would remain on the disk; ``purpose`` is named in the error."""
    free, wanted = shutil.disk_usage(folder).free, n_bytes + RESERVED_BYTES
    if free < wanted:
        raise DataError(
            f"{folder} has {free / 1e6:.1f} MB free, but {wanted / 1e6:.1f} MB are needed for {purpose}, including a "
            f"reserve of {RESERVED_BYTES / 1e6:.0f} MB; {_FREE_SPACE_REMEDY}"
        )


def temporary_path(path: Path, token: str) -> Path:
    """Return the temporary name under which ``path`` is written."""
    return path.with_name(f"{path.name}.{token}.part")


@contextmanager
def atomic_write(path: Path, *, overwrite: bool = False, token: str | None = None) -> Iterator[Path]:
    """Yield a temporary name to write to; when the block succeeds, that file is synchronised and renamed to ``path``.

    It ends in ``.part``, and is removed if the block fails. `check_target` runs before the block and before renaming.
    """
    check_target(path, overwrite=overwrite)
    part = temporary_path(path, token or secrets.token_hex(4))
    try:
        yield part
        fsync(part)
        check_target(path, overwrite=overwrite)
        part.replace(path)
    except BaseException as error:  # Ctrl-C must not leave a temporary file either.
        with suppress(OSError):  # The first error is the one to report.
            part.unlink(missing_ok=True)
        if isinstance(error, OSError) and (str(error.filename) == str(part) or _lacks_filename(error)):
            error.filename = str(path)  # The user does not know the temporary name.
        raise
    fsync(path.parent)


def _lacks_filename(error: OSError) -> bool:
    """Return True for an error of a full disk that names no file."""
    return error.filename is None and error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def make_folder(path: Path, *, parents: bool = False) -> None:
    """Create a folder, and synchronise its name with the disk even if it exists already."""
    missing = [each for each in path.parents if not each.exists()] if parents else []
    for each in (*reversed(missing), path):
        was_there = each.is_dir()
        each.mkdir(exist_ok=True)
        try:
            fsync(each.parent)
        except PermissionError:
            if not was_there:
                raise


def fsync(path: Path) -> None:
    """Synchronise a file, or the names in a folder, with the disk."""
    if path.is_dir() and os.name != "posix":
        return  # Windows cannot open folders.
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
