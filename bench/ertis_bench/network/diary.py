"""Diary of a sender, which survives any end of the sender."""

import json
import os
import zlib
from pathlib import Path
from typing import NamedTuple

from ertis_numba.frames import Measurement

__all__ = ["Diary", "DiaryKey", "Row"]


class DiaryKey(NamedTuple):
    """Key of a measurement."""

    sensor: str
    session_id: int
    sequence: int


class Row(NamedTuple):
    """Fields that must not change in transit."""

    crc32: int
    sync_count: int
    timestamp_ns: int

    @classmethod
    def of(cls, measurement: Measurement) -> "Row":
        """Return that of a measurement, whose CRC-32 is made here."""
        stamp = measurement.stamp
        return cls(zlib.crc32(measurement.data.data), stamp.sync_count, stamp.timestamp_ns)


class Diary:
    """Diary of a sender, line by line.

    Parameters
    ----------
    path : Path
        It is appended to.
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_CREAT | os.O_APPEND | os.O_WRONLY, 0o644)

    def offered(self, key: DiaryKey, row: Row, monotonic_ns: int) -> None:
        """Write that a measurement is going to be handed over."""
        self._write("offered", *key, *row, monotonic_ns)

    def kept(self, key: DiaryKey) -> None:
        """Write that it was accepted."""
        self._write("kept", *key)

    def acked_through(self, sensor: str, session_id: int, acked_through: int, status: str, monotonic_ns: int) -> None:
        """Write an acknowledgement to the diary."""
        self._write("acked_through", sensor, session_id, acked_through, status, monotonic_ns)

    def dropped(self, sensor: str, session_id: int, sequence: int, reason: str) -> None:
        """Write that the sender was told of one that was thrown away."""
        self._write("dropped", sensor, session_id, sequence, reason)

    def _write(self, *words: object) -> None:
        os.write(self._file, f"{json.dumps(words)}\n".encode())  # at once and in one piece
