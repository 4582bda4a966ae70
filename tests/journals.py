"""Journals shared by the tests of storing and sealing."""

import os
import shutil
import subprocess
import sys
import zlib
from dataclasses import replace

import numpy as np

from ertis_numba.journal import SUFFIX, Journal, JournalEntry
from ertis_numba.journal._tables import insert_statement
from ertis_numba.settings import Air, Recording
from tests.files import line, noise

ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
TINY = line(8, 8).replace(recording=Recording(n_samples=4096))
EPOCH = 5


def entries(count=3, *, sensor="left", first=10, settings=TINY, session_id=EPOCH, seed=1):
    """Journal entries of noise with different stamps, in order of arrival."""
    made = []
    for number, measurement in enumerate(noise(settings, count, seed)):
        stamp = replace(measurement.stamp, sensor=sensor, sequence=first + number, session_id=session_id)
        made.append(JournalEntry(replace(measurement, stamp=stamp), monotonic_ns=1_000 + number))
    return made


def both():
    """Alternating measurements of two sensors; the air of the first one changes."""
    left, right = entries(), entries(2, sensor="right", first=0, seed=2)
    warm = TINY.replace(air=Air(temperature_c=31.5, humidity_percent=12.0, pressure_pa=99_000.0))
    left[1] = replace(left[1], measurement=replace(left[1].measurement, settings=warm))
    return [left[0], right[0], left[1], left[2], right[1]]


def create(folder, given=None, *, name="rec.h5", target=None, settings=TINY):
    """Create a journal of ``rec.h5`` and append measurements, each in its own commit; return the open journal."""
    journal = Journal.create(folder / f"{name}{SUFFIX}", target=name if target is None else target, source="test")
    for entry in entries() if given is None else given:
        sensor = entry.measurement.stamp.sensor
        if sensor not in journal.sensors:
            journal.add_sensor(sensor, settings, firmware="1.2.3")
        journal.append([entry])
    return journal


def crashed(folder, given=None, *, moment="log", **options):
    """Create a journal in the state that a killed process leaves; return its path.

    The process ends with a write-ahead ``log`` not yet in the main file. In rollback mode it ends ``between`` two
    commits, or in the middle of a ``commit``.
    """
    (folder / "running").mkdir()
    with create(folder / "running", given, **options) as journal:
        execute = journal._database.execute  # noqa: SLF001  no public access
        if moment != "log":
            journal._database.use_rollback_journal()  # noqa: SLF001  otherwise 4 MB would be needed
        if moment == "commit":
            execute("PRAGMA cache_size = 1")  # SQLite writes pages beyond the cache before the commit
            execute("BEGIN")
            execute("UPDATE measurements SET crc32 = 0")
            execute("INSERT INTO gaps SELECT NULL, 1, 1, 1, 1, 'x', 0 FROM measurements, sensors")
            for number in range(60):
                execute(insert_statement("measurements"), (1, EPOCH, 100 + number, *[0] * 10, bytes(4096)))
        for path in (folder / "running").iterdir():
            shutil.copy(path, folder)
    shutil.rmtree(folder / "running")
    return folder / journal.path.name


def same(came, wanted):
    """Compare an entry that was read with the original, bit by bit; check its CRC-32."""
    words = [np.ascontiguousarray(entry.measurement.data) for entry in (came, wanted)]
    return (
        (came.monotonic_ns, came.measurement.stamp) == (wanted.monotonic_ns, wanted.measurement.stamp)
        and came.measurement.settings.air == wanted.measurement.settings.air
        and words[0].dtype == words[1].dtype
        and words[0].tobytes() == words[1].tobytes()
        and came.crc32 == zlib.crc32(words[1].data)
    )


def python(code, *arguments, **options):
    """Run Python code in a new process."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False, **options)
