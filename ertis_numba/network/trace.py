"""Trace of measurements on their way through the nodes, for ``ertis bench latency``; off unless it is requested."""

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from ertis_numba.base.errors import ArgumentError

__all__ = ["VARIABLE", "TraceWriter", "ignore", "mark"]

VARIABLE: Final = "ERTIS_TRACE"
"""Environment variable with the folder of traces; each process writes a file ``PID.trace`` of its own there."""


class TraceWriter:
    """Writer of a line per mark, which a killed process keeps; omits marks that the disk cannot take."""

    def __init__(self, folder: Path) -> None:
        if not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):
            raise ArgumentError(
                f"{VARIABLE} is '{folder}', which is not a folder that this user can write to; create it, or unset "
                f"{VARIABLE}"
            )
        self._folder = folder
        self._files: dict[int, int] = {}  # By process: a forked process needs a file of its own.

    def __call__(self, stage: str, sensor: str, sequence: int) -> None:
        """Record that a measurement has passed a stage."""
        now_ns, pid = time.monotonic_ns(), os.getpid()
        with suppress(OSError):
            if pid not in self._files:
                path = self._folder / f"{pid}.trace"
                self._files[pid] = os.open(path, os.O_CREAT | os.O_APPEND | os.O_WRONLY, 0o600)
            os.write(self._files[pid], f"{stage}\t{sensor}\t{sequence}\t{now_ns}\n".encode())


def ignore(stage: str, sensor: str, sequence: int) -> None:
    """Trace nothing; a call takes less than a tenth of a microsecond."""


_requested = os.environ.get(VARIABLE)
mark: Callable[[str, str, int], None] = TraceWriter(Path(_requested)) if _requested else ignore
"""Function that records that a measurement has passed a stage, given the stage, the sensor and the sequence number.

All processes of a machine share the monotonic clock, so their times can be subtracted.
"""
