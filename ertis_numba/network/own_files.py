"""Files that only their owner may read or change."""

import errno
import os
import stat
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from ertis_numba.atomic_files import atomic_write
from ertis_numba.errors import ArgumentError, NetworkError, SettingsError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["OTHERS", "locked", "mode_of", "private_folder", "require_own", "write"]

OTHERS: Final = 0o077
"""What a mode must not have where nobody else may use a file."""

_OTHERS_WRITE: Final = 0o022
_MAX_LINKS: Final = 40  # that a path leads through, as on Linux


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


def require_own(path: Path, about: str = "lists who is let in") -> None:
    """Refuse a file that other users of this machine may change or replace.

    Other users are all but this one and root. The function follows each link of the path and checks each folder of it,
    as StrictModes of OpenSSH does with the folders above ``authorized_keys``.

    Parameters
    ----------
    path : Path
    about : str
        What the file is for, in errors.

    Raises
    ------
    SettingsError
        They may.
    OSError
        There is no such file.
    """
    if os.name != "posix":
        return
    folders, links, file = _way_to(path)
    for where in (*links, *folders, file):
        status = where.lstat()
        given = path.absolute()
        what = "it" if where in (file, given) else "its folder" if where == given.parent else str(where)
        if status.st_uid not in (0, os.geteuid()):
            raise SettingsError(
                f"{path} {about} and others may change {what} (owned by user {status.st_uid}); "
                f"run 'chown {os.geteuid()} {where}', and review the file"
            )
        mode = stat.S_IMODE(status.st_mode)
        is_kept = where in links or (where in folders and mode & stat.S_ISVTX)  # others cannot put another in its place
        if mode & _OTHERS_WRITE and not is_kept:
            raise SettingsError(
                f"{path} {about} and others may change {what} (mode {mode:04o}); "
                f"run 'chmod go-w {where}', and review the file"
            )


def _way_to(path: Path) -> tuple[list[Path], list[Path], Path]:
    """Return the folders and links of a path, and the file at its end."""
    folders: dict[Path, None] = {}
    links: dict[Path, None] = {}
    here, left, n_followed = Path("/"), deque(path.absolute().parts[1:]), 0
    while left:
        folders[here] = None
        part = left.popleft()
        if part == "..":
            here = here.parent
            continue
        here /= part
        if not here.is_symlink():
            continue
        n_followed += 1
        if n_followed > _MAX_LINKS:
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
        links[here] = None
        target = here.readlink()
        left.extendleft(reversed(target.parts[1:] if target.is_absolute() else target.parts))
        here = Path("/") if target.is_absolute() else here.parent
    return list(folders), list(links), here


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
    with atomic_write(path, overwrite=overwrite) as part:
        descriptor = os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
