"""File operations in small steps, so that other processes can use the disk in between."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

__all__ = ["GradualSync", "gradual_unlink"]

_NICE: Final = 19  # The lowest priority.
_STEP_BYTES: Final = 4_000_000
_SHRINK_BYTES: Final = 32_000_000
_MAX_PAUSE_S: Final = 0.5


class GradualSync:
    """Gradual sync of a growing file, which need not exist yet, with a pause of ``rests`` times each step's duration.

    A single sync would write all buffered data at once, and the sync of another small file would have to wait. A
    journal's commit then took 370 ms instead of 47 ms.
    """

    def __init__(self, path: Path, rests: float) -> None:
        self._path, self._rests = path, rests
        self._done_bytes = 0
        if hasattr(os, "nice"):
            os.nice(_NICE)

    def __call__(self) -> None:
        """Sync the file if it has grown by one step since the last sync."""
        try:
            n_bytes = self._path.stat().st_size
        except FileNotFoundError:
            return
        if n_bytes - self._done_bytes < _STEP_BYTES:
            return
        begun_s = time.monotonic()
        _sync_data(self._path)
        self._done_bytes = n_bytes
        time.sleep(min(self._rests * (time.monotonic() - begun_s), _MAX_PAUSE_S))


def _sync_data(path: Path) -> None:
    descriptor = os.open(path, os.O_RDWR)
    try:
        getattr(os, "fdatasync", os.fsync)(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def gradual_unlink(path: Path, rests: float) -> Iterator[None]:
    """Truncate a file in steps if the block removes it, because freeing gigabytes at once blocks the disk."""
    if os.name != "posix" or not path.exists():
        yield
        return
    # Closing a file that SQLite has open in this process would release its locks, so this one is closed afterwards.
    descriptor = os.open(path, os.O_RDWR)
    try:
        yield
        while not os.fstat(descriptor).st_nlink and (left := os.fstat(descriptor).st_size):
            os.ftruncate(descriptor, max(0, left - _SHRINK_BYTES))
            begun_s = time.monotonic()
            os.fsync(descriptor)
            time.sleep(min(rests * (time.monotonic() - begun_s), _MAX_PAUSE_S))
    finally:
        os.close(descriptor)
