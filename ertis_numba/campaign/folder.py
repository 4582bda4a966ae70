"""Output folder of a campaign: one campaign at a time, without half-written files."""

import errno
import os
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from ertis_numba.base.errors import ArgumentError

__all__ = ["clear_parts", "exclusive_folder", "final_name"]

_PART = re.compile(r"(.+)\.[0-9a-f]{8}\.part")  # Names of `ertis_numba.base.atomic_files.atomic_write`.


@contextmanager
def exclusive_folder(folder: Path) -> Iterator[None]:
    """Create a folder unless it exists, and lock it until the block or, even by a crash, the process ends."""
    folder.mkdir(exist_ok=True)
    if os.name != "posix":  # Windows cannot open folders, so they cannot be locked.
        yield
        return
    import fcntl  # noqa: PLC0415  not on every system

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in {errno.EWOULDBLOCK, errno.EACCES}:
                raise ArgumentError(
                    f"output folder {folder} is in use by another campaign; wait for it, or choose another folder"
                ) from None
            # Some network file systems have no locks. The campaign then runs without one.
        yield
    finally:
        os.close(descriptor)


def final_name(name: str) -> str:
    """Return the final name of a file, given its final or temporary name."""
    part = _PART.fullmatch(name)
    return part[1] if part else name


def clear_parts(folder: Path, targets: Collection[str]) -> None:
    """Remove temporary files that killed writers of these targets have left."""
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries]
    for name in names:
        part = _PART.fullmatch(name)
        if part and part[1] in targets:
            (folder / name).unlink(missing_ok=True)
