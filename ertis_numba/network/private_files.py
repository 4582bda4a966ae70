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

from ertis_numba.base.atomic_files import atomic_write
from ertis_numba.base.errors import ArgumentError, NetworkError, SettingsError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["OTHERS", "locked", "mode_of", "private_folder", "require_own", "write"]

OTHERS: Final = 0o077
"""Permission bits of group and others."""

_OTHERS_WRITE: Final = 0o022
_MAX_LINKS: Final = 40  # Limit on symbolic links of a path, as on Linux.


def private_folder(folder: Path) -> Path:
    """Return a folder that only its owner can use; create it if necessary."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        mode = mode_of(folder)
    except OSError as error:
        raise NetworkError(f"{folder}: {error.strerror}; choose a writable folder (folder)") from error
    if mode & OTHERS:
        raise ArgumentError(
            f"other users can access {folder} (mode {mode:04o}); run 'chmod 700 {folder}', or choose another folder "
            "(folder)"
        )
    return folder


def require_own(path: Path, about: str = "is an allow list of keys") -> None:
    """Raise SettingsError for a file that users other than this one and root may change or replace."""
    # It follows each link and checks each folder, as StrictModes of OpenSSH does. OSError if the file does not exist.
    if os.name != "posix":
        return
    folders, links, file = _way_to(path)
    for where in (*links, *folders, file):
        status = where.lstat()
        given = path.absolute()
        part = "it" if where in (file, given) else "its folder" if where == given.parent else str(where)
        if status.st_uid not in (0, os.geteuid()):
            raise SettingsError(
                f"{path} {about}, but other users may change {part} (owned by user {status.st_uid}); run 'chown "
                f"{os.geteuid()} {where}', and review the file"
            )
        mode = stat.S_IMODE(status.st_mode)
        # The sticky bit keeps other users from replacing it.
        is_kept = where in links or (where in folders and mode & stat.S_ISVTX)
        if mode & _OTHERS_WRITE and not is_kept:
            raise SettingsError(
                f"{path} {about}, but other users may change {part} (mode {mode:04o}); run 'chmod go-w {where}', "
                "and review the file"
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
    """Return the permission bits of a file or folder; owner only, on systems without such bits."""
    return stat.S_IMODE(path.stat().st_mode) if os.name == "posix" else 0


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock of a file during a block, so that only one process at a time is in such a block."""
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)
    except OSError as error:
        raise NetworkError(f"{path.parent}: {error.strerror}; choose a writable folder") from error
    try:
        if sys.platform == "win32":
            msvcrt.locking(descriptor, msvcrt.LK_LOCK, 1)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def write(path: Path, text: str, *, mode: int, overwrite: bool = False) -> None:
    """Write a file with its final permissions from the start."""
    with atomic_write(path, overwrite=overwrite) as part:
        descriptor = os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
