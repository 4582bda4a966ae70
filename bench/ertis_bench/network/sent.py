"""Sent measurements, according to the senders' diaries.

A sender writes a line before and after it hands a measurement over, and for every acknowledgement. The file is opened
for appending, so that its lines survive any end of the sender.
"""

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from ertis_bench.network.diary import DiaryKey, Row

__all__ = ["Sent", "note", "read_diaries"]


@dataclass(slots=True)
class Sent:
    """Measurements in the senders' diaries.

    Attributes
    ----------
    offered : dict of DiaryKey to Row
        All measurements that may be stored.
    arrived_ns : dict of DiaryKey to int
        Time at which the whole measurement was at the sender.
    kept : set of DiaryKey
        Accepted measurements.
    acked_through : dict of (sensor, session_id) to int
        Number up to which all measurements were acknowledged.
    acked_ns : dict of DiaryKey to int
        Time of the first acknowledgement that covers the measurement.
    statuses : Counter of str
        Numbers of acknowledgements by status.
    dropped : dict of DiaryKey to str
        Reasons of discarded measurements.
    """

    offered: dict[DiaryKey, Row] = field(default_factory=dict)
    arrived_ns: dict[DiaryKey, int] = field(default_factory=dict)
    kept: set[DiaryKey] = field(default_factory=set)
    acked_through: dict[tuple[str, int], int] = field(default_factory=dict)
    acked_ns: dict[DiaryKey, int] = field(default_factory=dict)
    statuses: Counter[str] = field(default_factory=Counter)
    dropped: dict[DiaryKey, str] = field(default_factory=dict)

    def acked(self) -> set[DiaryKey]:
        """Return the measurements that were acknowledged."""
        return {key for key in self.kept if key.sequence <= self.acked_through.get((key.sensor, key.session_id), -1)}

    def ack_times_ms(self) -> list[float]:
        """Return the time of each acknowledgement after the arrival of the measurement at the sender, in ms."""
        return sorted((at_ns - self.arrived_ns[key]) / 1e6 for key, at_ns in self.acked_ns.items())


def read_diaries(paths: Iterable[Path]) -> Sent:
    """Return the content of the senders' diaries, without a truncated last line."""
    sent = Sent()
    for path in paths:
        for line in path.read_bytes().splitlines(keepends=True):
            if line.endswith(b"\n"):
                note(sent, *json.loads(line))
    return sent


def note(sent: Sent, what: str, sensor: str, session_id: int, number: int, *rest: int | str) -> None:
    """Add one line of a diary to ``sent``."""
    key = DiaryKey(sensor, session_id, number)
    match what, rest:
        case "offered", (int(crc32), int(sync_count), int(timestamp_ns), int(monotonic_ns)):
            sent.offered[key] = Row(crc32, sync_count, timestamp_ns)
            sent.arrived_ns[key] = monotonic_ns
        case "kept", ():
            sent.kept.add(key)
        case "acked_through", (str(status), int(monotonic_ns)):
            before = sent.acked_through.get((sensor, session_id), -1)
            for sequence in range(before + 1, number + 1):
                acked = DiaryKey(sensor, session_id, sequence)
                if acked in sent.arrived_ns:
                    sent.acked_ns[acked] = monotonic_ns
            sent.acked_through[sensor, session_id] = max(before, number)
            sent.statuses[status] += 1
        case "dropped", (str(reason),):
            sent.dropped[key] = reason
