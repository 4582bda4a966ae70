"""Comparison of the sent measurements, from the senders' logs, with those that readers of recordings return.

A sender writes a line before and after it hands a measurement over, and whenever it is told what is settled. The file
is opened to append, so that it holds what was written whatever ends the sender. Nothing here knows of journals, acks or
ledgers: the words of every measurement are read by `open_recording`, and their CRC-32 is made anew.
"""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from ertis_bench.network.diary import DiaryKey, Row
from ertis_numba.errors import ErtisError
from ertis_numba.frames import Measurement
from ertis_numba.storage import RecordingGap, open_recording, sensor_names

__all__ = ["Archived", "Sent", "compare", "note", "read_diaries", "read_folder"]

_UNTOLD: Final = "not among the measurements given"  # what a recording says of numbers that nobody has explained


@dataclass(slots=True)
class Sent:
    """Measurements in the senders' diaries.

    Attributes
    ----------
    offered : dict of DiaryKey to Row
        All that may be there.
    arrived_ns : dict of DiaryKey to int
        When all of it was there, at the sender.
    kept : set of DiaryKey
        What was accepted.
    acked_through : dict of (sensor, epoch) to int
        The highest number that was acked, and all before it.
    acked_ns : dict of DiaryKey to int
        When the first ack that covers it came.
    statuses : Counter of str
        Acks by what they mean.
    dropped : dict of DiaryKey to str
    """

    offered: dict[DiaryKey, Row] = field(default_factory=dict)
    arrived_ns: dict[DiaryKey, int] = field(default_factory=dict)
    kept: set[DiaryKey] = field(default_factory=set)
    acked_through: dict[tuple[str, int], int] = field(default_factory=dict)
    acked_ns: dict[DiaryKey, int] = field(default_factory=dict)
    statuses: Counter[str] = field(default_factory=Counter)
    dropped: dict[DiaryKey, str] = field(default_factory=dict)

    def acked(self) -> set[DiaryKey]:
        """Return the measurements that were acked."""
        return {key for key in self.kept if key.sequence <= self.acked_through.get((key.sensor, key.session_id), -1)}

    def ack_times_ms(self) -> list[float]:
        """Return how long each ack took, from the arrival of the measurement at the sender."""
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
    """Take note of one line of a diary."""
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


@dataclass(slots=True)
class Archived:
    """Content of the recordings in a folder.

    Attributes
    ----------
    rows : dict of DiaryKey to list of Row
        More than one where something was stored twice.
    gaps : dict of (sensor, epoch) to list of Gap
    recordings, broken, left_over : list of str
        Names of files: those that were read; those that could not be; those that ought to be gone.
    """

    rows: dict[DiaryKey, list[Row]] = field(default_factory=lambda: defaultdict(list))
    gaps: dict[tuple[str, int], list[RecordingGap]] = field(default_factory=lambda: defaultdict(list))
    recordings: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    left_over: list[str] = field(default_factory=list)

    def reason(self, key: DiaryKey) -> str | None:
        """Return why a measurement is missing, None where no recording tells."""
        reasons = [
            gap.reason
            for gap in self.gaps.get((key.sensor, key.session_id), ())
            if gap.first <= key.sequence <= gap.last
        ]
        return next((reason for reason in reasons if reason != _UNTOLD), None)


def read_folder(folder: Path) -> Archived:
    """Read all recordings of a folder, every word of them."""
    found = Archived()
    for path in sorted(folder.iterdir()):
        if path.suffix != ".h5":
            if any(part in path.name for part in (".journal", ".part", ".damaged")):
                found.left_over.append(path.name)
            continue
        try:
            for sensor, measurement in _measurements(path, found):
                stamp = measurement.stamp
                found.rows[DiaryKey(sensor, stamp.session_id, stamp.sequence)].append(Row.of(measurement))
        except (ErtisError, OSError) as error:
            found.broken.append(f"{path.name}: {error}")
        else:
            found.recordings.append(path.name)
    return found


def _measurements(path: Path, found: Archived) -> Iterator[tuple[str, Measurement]]:
    for sensor in sensor_names(path):
        with open_recording(path, sensor=sensor) as recording:
            for gap in recording.gaps:
                found.gaps[sensor, gap.session_id].append(gap)
            for measurement in recording:
                yield sensor, measurement


def compare(sent: Sent, archived: Archived, promised: AbstractSet[DiaryKey]) -> dict[str, int]:
    """Return the differences.

    Parameters
    ----------
    sent : Sent
    archived : Archived
    promised : set of DiaryKey
        What has to be there, such as all that was acked.

    Returns
    -------
    dict of str to int
        ``promised`` and ``stored``. Then what ought to be 0: of what was promised, ``lost`` without a word, and
        ``missing`` with a reason reported; ``wrong``, with other words or another time than were sent; ``twice``;
        ``unexpected``, never sent; ``silent``, numbers below the highest of a run that neither are there nor told to be
        missing; ``broken`` recordings; files ``left_over``.
    """
    rows = archived.rows
    absent = {key: archived.reason(key) for key in promised if key not in rows}
    highest: dict[tuple[str, int], int] = {}
    for key in rows:
        run = (key.sensor, key.session_id)
        highest[run] = max(highest.get(run, -1), key.sequence)
    numbers = (DiaryKey(*run, sequence) for run, last in highest.items() for sequence in range(last))
    return {
        "promised": len(promised),
        "stored": len(rows),
        "lost": sum(reason is None for reason in absent.values()),
        "missing": sum(reason is not None for reason in absent.values()),
        "wrong": sum(key in sent.offered and any(row != sent.offered[key] for row in rows[key]) for key in rows),
        "twice": sum(len(each) > 1 for each in rows.values()),
        "unexpected": sum(key not in sent.offered for key in rows),
        "silent": sum(key not in rows and archived.reason(key) is None for key in numbers),
        "broken": len(archived.broken),
        "left_over": len(archived.left_over),
    }
