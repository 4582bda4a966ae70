"""Files that only their owner may read or change."""

import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from ertis_numba.atomic import replacing
from ertis_numba.errors import ArgumentError, NetworkError, SettingsError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["OTHERS", "locked", "mode_of", "private_folder", "require_own", "write"]

OTHERS: Final = 0o077
"""What a mode must not have where nobody else may use a file."""

_OTHERS_WRITE: Final = 0o022


def private_folder(folder: Path) -> Path:
    """Return a folder that only its owner can use, made if it is not there."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        mode = mode_of(folder)
    except OSError as error:
        raise NetworkError(f"{folder}: {error.strerror}; give a folder that can be written (--dir)") from error
    if mode & OTHERS:
        raise ArgumentError(
            f"{folder} can be used by others (mode {mode:04o}); run 'chmod 700 {folder}', or give another (--dir)"
        )
    return folder


def require_own(path: Path) -> None:
    """Refuse a list of keys that others on this machine may change, by itself or by another in its place.

    Raises
    ------
    SettingsError
        They may.
    """
    for where, what in ((path, "it"), (path.parent, "its folder")):
        mode = mode_of(where)
        if mode & _OTHERS_WRITE and not mode & stat.S_ISVTX:
            raise SettingsError(
                f"{path} says who is let in and others may change {what} (mode {mode:04o}); "
                f"run 'chmod go-w {where}', and look at what it says"
            )


def mode_of(path: Path) -> int:
    """Return who may use a file or folder; nobody else, where a system does not say."""
    return stat.S_IMODE(path.stat().st_mode) if os.name == "posix" else 0


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Wait until nobody else is in such a block; a process that ends leaves it."""
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)
    except OSError as error:
        raise NetworkError(f"{path.parent}: {error.strerror}; give a folder that can be written") from error
    try:
        if sys.platform == "win32":
            msvcrt.locking(descriptor, msvcrt.LK_LOCK, 1)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def write(path: Path, text: str, *, mode: int, overwrite: bool = False) -> None:
    """Write a file that was never open to more than it is to be open to."""
    with replacing(path, overwrite=overwrite) as part:
        descriptor = os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
