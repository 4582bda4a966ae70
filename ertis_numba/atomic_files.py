"""A file appears under its name complete, or not at all."""

import errno
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ertis_numba.errors import ArgumentError, DataError

__all__ = [
    "RESERVED_BYTES",
    "atomic_write",
    "check_target",
    "fsync",
    "make_folder",
    "remedy",
    "require_free_space",
    "temporary_path",
]

# HDF5 that meets a full disk while it closes a file can take the whole process with it (h5py issue
# 914), so writing stops while there is still room for its tables.
RESERVED_BYTES = 8_000_000

_FREE_SPACE_REMEDY = "free some space or write elsewhere"
_PERMISSION_REMEDY = "see who may use it and its folder, or choose another"
_MISSING_FOLDER_REMEDY = "see whether its folder is there, or choose another"
_REMEDIES = {
    errno.EACCES: _PERMISSION_REMEDY,
    errno.EPERM: _PERMISSION_REMEDY,
    errno.EROFS: _PERMISSION_REMEDY,
    errno.ENOENT: _MISSING_FOLDER_REMEDY,
    errno.ENOTDIR: _MISSING_FOLDER_REMEDY,
    errno.ENAMETOOLONG: "give a shorter name",
    errno.EDQUOT: _FREE_SPACE_REMEDY,
    errno.EFBIG: _FREE_SPACE_REMEDY,
    errno.ENOSPC: _FREE_SPACE_REMEDY,
}


def check_target(path: Path, *, overwrite: bool, sources: Iterable[Path] = ()) -> None:
    """Refuse a path where no file can be put.

    Parameters
    ----------
    path : Path
    overwrite : bool
    sources : iterable of Path
        Files that are read from, which are not overwritten whatever is asked for.

    Raises
    ------
    ArgumentError
        The folder is missing, the path is a folder, a link, a device or a source, or a file is there and
        may not be replaced.
    """
    if path.is_dir():
        raise ArgumentError(f"output {path} is a folder; give the name of a file")
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise ArgumentError(f"output {path} is a link or a device; give the name of a file")
    if not path.parent.is_dir():
        raise ArgumentError(f"output {path}: there is no folder {path.parent}; make it or give another")
    if path.exists() and any(source.exists() and source.samefile(path) for source in sources):
        raise ArgumentError(f"output {path} is the input itself; give another name")
    if path.exists() and not overwrite:
        raise ArgumentError(f"output {path} exists; give another name, or ask to overwrite it (--force)")


def remedy(error: Exception) -> str:
    """Return what helps against an error of the system, whose number HDF5 has in the middle of its own words."""
    inner = re.search(r"errno = (\d+)", str(error))
    number = int(inner[1]) if inner else getattr(error, "errno", None)
    return _REMEDIES.get(number or 0, "look at the disk, or write elsewhere")


def require_free_space(folder: Path, n_bytes: int, *, purpose: str = "what is next") -> None:
    """Refuse to write ``n_bytes`` into a folder that would then have no room to spare.

    Errors name the ``purpose`` of the bytes.

    Raises
    ------
    DataError
        The disk is full, or nearly so.
    """
    free, wanted = shutil.disk_usage(folder).free, n_bytes + RESERVED_BYTES
    if free < wanted:
        raise DataError(
            f"{folder} has {free / 1e6:.1f} MB free, wanted {wanted / 1e6:.1f} MB for {purpose}, "
            f"{RESERVED_BYTES / 1e6:.0f} MB of it to spare; {_FREE_SPACE_REMEDY}"
        )


def temporary_path(path: Path, token: str) -> Path:
    """Return the name under which a file is written that is to become ``path``."""
    return path.with_name(f"{path.name}.{token}.part")


@contextmanager
def atomic_write(path: Path, *, overwrite: bool = False, token: str | None = None) -> Iterator[Path]:
    """Yield the name to write to; when the block ends well, that file becomes ``path``.

    The name ends in ``.part`` and is nobody else's, so that two writers never share it. The
    file reaches the disk before it takes its name. Whatever ends the block, no ``.part`` is left.

    Parameters
    ----------
    path : Path
    overwrite : bool
    token : str, optional
        What makes the name nobody else's; some random digits by default.

    Raises
    ------
    ArgumentError
        As `check_target`, before the block and again before the file takes its name.
    OSError
        The file cannot be written; its ``filename`` is ``path``.
    """
    check_target(path, overwrite=overwrite)
    part = temporary_path(path, token or secrets.token_hex(4))
    try:
        yield part
        fsync(part)
        check_target(path, overwrite=overwrite)
        part.replace(path)
    except BaseException as error:  # Ctrl-C, too, must leave nothing behind
        with suppress(OSError):  # where nothing can be written, nothing can be removed: what came first is to be told
            part.unlink(missing_ok=True)
        if isinstance(error, OSError) and (str(error.filename) == str(part) or _lacks_filename(error)):
            error.filename = str(path)  # nobody else knows the name of a part
        raise
    fsync(path.parent)


def _lacks_filename(error: OSError) -> bool:
    """Whether an error says that a disk is full, but not which file it was that had no room."""
    return error.filename is None and error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def make_folder(path: Path, *, parents: bool = False) -> None:
    """Make a folder and its name durable, even if the folder exists already.

    Parameters
    ----------
    path : Path
    parents : bool
        Make missing parents, too.

    Raises
    ------
    OSError
        It cannot be made.
    """
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
    """Bring a file, or the names in a folder, to the disk."""
    if path.is_dir() and os.name != "posix":
        return  # there, a folder cannot be opened
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
