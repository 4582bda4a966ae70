"""Comparison of sent measurements, according to the senders' diaries, with those that readers of recordings return.

The comparison is independent of journals, acknowledgements and ledgers: `open_recording` reads the words of every
measurement, and their CRC-32 is recomputed.
"""

from collections import defaultdict
from collections.abc import Iterator, Set as AbstractSet
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from ertis_bench.network.diary import DiaryKey, Row
from ertis_bench.network.sent import Sent, read_diaries
from ertis_numba.base.errors import ErtisError
from ertis_numba.frames import Measurement, SequenceGap
from ertis_numba.storage import open_recording, sensor_names

__all__ = ["Archived", "compare", "judged", "read_folder", "tracebacks"]

_UNEXPLAINED: Final = "not among the measurements given"  # reason in recordings for unexplained gaps


@dataclass(slots=True)
class Archived:
    """Content of the recordings in a folder.

    Attributes
    ----------
    rows : dict of DiaryKey to list of Row
        Stored measurements. A list has more than one row if a measurement was stored twice.
    gaps : dict of (sensor, session_id) to list of SequenceGap
    recordings, broken, left_over : list of str
        Names of files: recordings that were read, unreadable recordings, and files that should have been removed.
    """

    rows: dict[DiaryKey, list[Row]] = field(default_factory=lambda: defaultdict(list))
    gaps: dict[tuple[str, int], list[SequenceGap]] = field(default_factory=lambda: defaultdict(list))
    recordings: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    left_over: list[str] = field(default_factory=list)

    def reason(self, key: DiaryKey) -> str | None:
        """Return the reason why a measurement is missing, or None if no recording states one."""
        reasons = [
            gap.reason
            for gap in self.gaps.get((key.sensor, key.session_id), ())
            if gap.first <= key.sequence <= gap.last
        ]
        return next((reason for reason in reasons if reason != _UNEXPLAINED), None)


def read_folder(folder: Path) -> Archived:
    """Read all recordings of a folder, including every word."""
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
    """Return the differences between sent and stored measurements.

    Returns
    -------
    dict of str to int
        ``promised`` and ``stored``, and counts that must be 0. Of the promised measurements: ``lost`` without a reason,
        and ``missing`` with a reason. Of the stored ones: ``wrong``, with other words or another time than sent;
        ``twice``; and ``unexpected``, never sent. ``silent``, numbers below the highest of a session that are neither
        stored nor reported as missing. ``broken`` recordings, and files ``left_over``.
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


def tracebacks(folder: Path) -> int:
    """Return the number of tracebacks in the output of a trial."""
    return sum(path.read_text(errors="replace").count("Traceback (most") for path in folder.glob("*.txt"))


def judged(folder: Path, archive: Path, diaries: list[Path], *, kept: list[Path] | None = None) -> dict[str, Any]:
    """Compare the sent measurements with the stored ones."""
    sent = read_diaries(diaries)
    surely: Sent = sent if kept is None else read_diaries(kept)
    promised = surely.kept | sent.acked()
    return compare(sent, read_folder(archive), promised) | {
        "offered": len(sent.offered),
        "acked": len(sent.acked()),
        "tracebacks": tracebacks(folder),
    }
