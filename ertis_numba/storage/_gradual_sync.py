"""Work on files that leaves the disk to others: little of it at a time."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

__all__ = ["GradualSync", "shrinking"]

_NICE: Final = 19  # the lowest priority that there is
_STEP_BYTES: Final = 4_000_000
_SHRINK_BYTES: Final = 32_000_000
_MAX_REST_S: Final = 0.5


class GradualSync:
    """Brings a file that grows to the disk step by step, and rests after each.

    What gathers in memory goes to the disk at once when it is synced, and whoever wants to sync a little file then
    has to wait for all of it: a commit beside it took 370 ms instead of 47.

    Parameters
    ----------
    path : Path
        It may not be there yet.
    rests : float
        How many times as long as a step the rest after it is.
    """

    def __init__(self, path: Path, rests: float) -> None:
        self._path, self._rests = path, rests
        self._done_bytes = 0
        if hasattr(os, "nice"):
            os.nice(_NICE)

    def __call__(self) -> None:
        """Do a step if it is time for one."""
        try:
            n_bytes = self._path.stat().st_size
        except FileNotFoundError:
            return
        if n_bytes - self._done_bytes < _STEP_BYTES:
            return
        begun_s = time.monotonic()
        _sync_data(self._path)
        self._done_bytes = n_bytes
        time.sleep(min(self._rests * (time.monotonic() - begun_s), _MAX_REST_S))


def _sync_data(path: Path) -> None:
    descriptor = os.open(path, os.O_RDWR)
    try:
        getattr(os, "fdatasync", os.fsync)(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def shrinking(path: Path, rests: float) -> Iterator[None]:
    """If the block removes a file, give its room back little by little: to free GB at once keeps the disk busy."""
    if os.name != "posix" or not path.exists():
        yield
        return
    # To close a file that SQLite has open in this process would end its locks: this one is closed after it.
    descriptor = os.open(path, os.O_RDWR)
    try:
        yield
        while not os.fstat(descriptor).st_nlink and (left := os.fstat(descriptor).st_size):
            os.ftruncate(descriptor, max(0, left - _SHRINK_BYTES))
            begun_s = time.monotonic()
            os.fsync(descriptor)
            time.sleep(min(rests * (time.monotonic() - begun_s), _MAX_REST_S))
    finally:
        os.close(descriptor)
