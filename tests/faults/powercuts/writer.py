"""Process that appends to one journal and continues after errors: ``python -m tests.faults.powercuts.writer``.

Its commits are short and long. Commits of more than 4 MB bypass the write-ahead log.
"""

import json
import os
import random
import sys
from pathlib import Path

import numpy as np
from ertis_bench.network.diary import Row

from ertis_numba.base.errors import DataError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.journal import SUFFIX, Journal, JournalEntry
from ertis_numba.settings import Recording, Settings

_SETTINGS = Settings(recording=Recording(n_samples=32_768))
_SENSOR, _SESSION_ID = "front", 7
_LONG, _SHORT = 34, 3  # Measurements per commit. 34 measurements have more than 4 MB.


def main(folder: Path, seed: int, n_commits: int) -> None:
    """Append commits to a journal of ``rec.h5``, and print a line for each durable measurement."""
    rng = random.Random(seed)
    words = np.random.default_rng(seed).integers(0, 2**32, _SETTINGS.recording.n_samples, dtype=np.uint32)
    long_from = rng.randrange(n_commits + 2)
    path = folder / f"rec.h5{SUFFIX}"
    with Journal.create(path, target="rec.h5", source="bench") as journal:
        journal.add_sensor(_SENSOR, _SETTINGS)
        sequence = 0
        for number in range(n_commits):
            count = _LONG if number == long_from else rng.randint(1, _SHORT)
            entries = []
            for _ in range(count):
                words[:2] = sequence, seed & 0xFFFFFFFF
                stamp = Stamp(sensor=_SENSOR, sequence=sequence, sync_count=sequence, session_id=_SESSION_ID)
                entries.append(JournalEntry(Measurement(words.copy(), _SETTINGS, stamp), monotonic_ns=sequence))
                sequence += 1
            _append(journal, entries, rng)
            if rng.random() < 0.2:
                _discard(journal, sequence - 2 * _SHORT)


def _append(journal: Journal, entries: list[JournalEntry], rng: random.Random) -> None:
    """Retry an append until it succeeds, or discard the measurements, as a full spool does."""
    while True:
        try:
            journal.append(entries)
        except DataError:
            if rng.random() < 0.5:
                return
            continue
        break
    for entry in entries:
        row, stamp = Row.of(entry.measurement), entry.measurement.stamp
        _print(
            {
                "event": "stored",
                "sensor": stamp.sensor,
                "session_id": stamp.session_id,
                "sequence": stamp.sequence,
                **row._asdict(),
            }
        )


def _discard(journal: Journal, up_to: int) -> None:
    """Discard measurements as a spool does. From now on they need not be stored."""
    _print({"event": "discarded", "sensor": _SENSOR, "session_id": _SESSION_ID, "sequence": up_to})
    try:
        journal.discard(_SENSOR, _SESSION_ID, up_to)
    except DataError:
        return


def _print(event: dict[str, object]) -> None:
    os.write(1, f"{json.dumps(event)}\n".encode())


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
