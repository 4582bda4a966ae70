"""Log of a sender on disk, called its diary, which survives any end of the sender."""

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
        """Return the row of a measurement, with a newly computed CRC-32."""
        stamp = measurement.stamp
        return cls(zlib.crc32(measurement.data.data), stamp.sync_count, stamp.timestamp_ns)


class Diary:
    """Diary of a sender, one JSON line per event."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_CREAT | os.O_APPEND | os.O_WRONLY, 0o644)

    def offered(self, key: DiaryKey, row: Row, monotonic_ns: int) -> None:
        """Record that a measurement is about to be handed over."""
        self._write("offered", *key, *row, monotonic_ns)

    def kept(self, key: DiaryKey) -> None:
        """Record that a measurement was accepted."""
        self._write("kept", *key)

    def acked_through(self, sensor: str, session_id: int, acked_through: int, status: str, monotonic_ns: int) -> None:
        """Record an acknowledgement."""
        self._write("acked_through", sensor, session_id, acked_through, status, monotonic_ns)

    def dropped(self, sensor: str, session_id: int, sequence: int, reason: str) -> None:
        """Record that the sender reported a measurement as discarded."""
        self._write("dropped", sensor, session_id, sequence, reason)

    def _write(self, *words: object) -> None:
        os.write(self._file, f"{json.dumps(words)}\n".encode())  # A single write makes the line atomic and immediate.
