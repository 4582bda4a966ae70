"""Kills of processes that write or seal a journal. Reported measurements must survive each kill.

A nursery process, ``python -m tests.faults.kills``, imports all modules once, and forks each process to be killed. A
fork takes milliseconds, so that hundreds of kills are possible. Half of the processes are killed after a random time.
The others are killed before a random line of this package's own code, because most time is spent inside few calls.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import IO, Any, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

import ertis_numba
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.journal import Journal, JournalEntry
from ertis_numba.settings import Recording, Settings

__all__ = ["appending", "sealing"]

_SETTINGS = Settings(recording=Recording(n_samples=32_768))
_SENSORS = ("left", "right")
_SESSION_ID = 7
_SECOND_SENSOR_AFTER = 3  # Number of measurements of the first sensor before the second sensor joins.
_MAX_REPORTED = 12  # maximum number of commits before the kill
_LINES_OF_A_COMMIT = 170  # approximate
_JITTER_S = 0.004
_KILLS_PER_JOURNAL = 3  # consecutive processes that are killed over the same journal
_LIFE_S = 60  # lifetime of a process that is not killed
_PACKAGE = Path(ertis_numba.__file__).parent
_OURS = tuple(str(_PACKAGE / name) for name in ("journal", "storage", "base/atomic_files.py"))


def appending(folder: Path, *, seed: int, count: int) -> dict[str, int]:
    """Kill ``count`` processes that append to journals, and count reported measurements that are lost.

    Returns
    -------
    dict of str to int
        ``kills``, and measurements ``reported``; of the reported ones, ``lost`` and ``wrong``; ``untold``, stored
        although the kill came before the report; and ``unexpected``, never appended.
    """
    rng = random.Random(seed)
    found = dict.fromkeys(("kills", "told", "lost", "wrong", "untold", "unexpected"), 0)
    path = folder / "rec.h5.journal"
    with _Nursery() as nursery:
        while found["kills"] < count:
            reported: set[tuple[str, int]] = set()
            for _ in range(min(_KILLS_PER_JOURNAL, count - found["kills"])):
                reported |= _killed_appending(nursery, path, rng, seed)
                found["kills"] += 1
            _count_content(path, reported, seed, found)
    return found


def _killed_appending(nursery: "_Nursery", path: Path, rng: random.Random, seed: int) -> set[tuple[str, int]]:
    """Kill a process while it appends, and return the keys that it reported."""
    lines = rng.randrange(_MAX_REPORTED * _LINES_OF_A_COMMIT) if rng.random() < 0.5 else None
    nursery.begin("append", path=str(path), seed=seed, dies_after_lines=lines)
    reported: list[str] = []
    if lines is None:
        wanted = rng.randrange(_MAX_REPORTED)
        while len(reported) < wanted:
            reported.append(nursery.line())
        time.sleep(rng.uniform(0.0, _JITTER_S))
        nursery.kill()
    reported += nursery.end()
    return {(sensor, int(sequence)) for sensor, sequence in map(str.split, reported)}


def _count_content(path: Path, reported: set[tuple[str, int]], seed: int, found: dict[str, int]) -> None:
    """Count the content of a journal, and remove the journal."""
    found["told"] += len(reported)
    if not path.exists():  # The process was killed before it created the journal.
        found["lost"] += len(reported)
        return
    with Journal.open(path) as journal:
        keys = {(key.sensor, key.sequence): key for key in journal.index()}
        found["lost"] += len(reported - keys.keys())
        found["untold"] += len(keys.keys() - reported)
        for (sensor, sequence), key in keys.items():
            entry = journal.entry(key)
            same = np.array_equal(entry.measurement.data, _words(seed, sensor, sequence))
            found["wrong"] += not (same and entry.monotonic_ns == sequence and key.session_id == _SESSION_ID)
        for sensor in journal.sensors:
            numbers = [key.sequence for key in journal.index(sensor)]
            found["unexpected"] += numbers != list(range(len(numbers)))
        journal.remove()
    found["unexpected"] += len(list(path.parent.iterdir()))


def _append(*, path: str, seed: int) -> None:
    """Append to a journal until killed, and print the keys of durable measurements."""
    place = Path(path)
    journal = Journal.open(place) if place.exists() else Journal.create(place, target="rec.h5", source="kills")
    rng = random.Random(f"{seed} {len(journal)}")
    counts = {sensor: len(journal.index(sensor)) if sensor in journal.sensors else 0 for sensor in _SENSORS}
    while True:
        entries = []
        for _ in range(rng.randint(1, 3)):
            sensor = rng.choice(_SENSORS[: 1 + (counts[_SENSORS[0]] > _SECOND_SENSOR_AFTER)])
            if sensor not in journal.sensors:
                journal.add_sensor(sensor, _SETTINGS, firmware="1.2.3")
            stamp = Stamp(sensor=sensor, sequence=counts[sensor], session_id=_SESSION_ID)
            measurement = Measurement(_words(seed, sensor, counts[sensor]), _SETTINGS, stamp)
            entries.append(JournalEntry(measurement, monotonic_ns=counts[sensor]))
            counts[sensor] += 1
        journal.append(entries)
        for entry in entries:
            _emit_event(f"{entry.measurement.stamp.sensor} {entry.measurement.stamp.sequence}")


def _words(seed: int, sensor: str, sequence: int) -> NDArray[np.uint32]:
    """Return the words of a measurement, which its key determines."""
    rng = np.random.default_rng([seed, _SENSORS.index(sensor), sequence])
    return rng.integers(0, 2**32, _SETTINGS.recording.n_samples, dtype=np.uint32)


def sealing(folder: Path, *, seed: int, count: int) -> dict[str, int]:
    """Kill ``count`` processes that seal a journal, and report the result of the final sealing.

    Returns
    -------
    dict of str to int
        ``kills``; of them ``late``, after the end of the sealing. ``broken``, recordings that were unreadable under
        their final name at least once. ``different``, recordings that differ from that of an undisturbed sealing.
        ``left_over``, remaining files.
    """
    rng = random.Random(seed)
    found = dict.fromkeys(("kills", "late", "broken", "different", "left_over"), 0)
    crashed, work = folder / "crashed", folder / "work"
    _make_crashed_journal(crashed, seed)
    with _Nursery() as nursery:
        n_lines, lasts_s, wanted = _seal_undisturbed(nursery, crashed, work)
        while found["kills"] < count:
            path = shutil.copytree(crashed, work) / "rec.h5.journal"
            for _ in range(min(rng.randint(1, _KILLS_PER_JOURNAL), count - found["kills"])):
                found["late"] += not _killed_sealing(nursery, path, rng, n_lines, lasts_s)
                found["kills"] += 1
                found["broken"] += (work / "rec.h5").exists() and (work / "rec.h5").read_bytes() != wanted
            nursery.begin("seal", path=str(path))
            nursery.end()
            found["different"] += (work / "rec.h5").read_bytes() != wanted
            found["left_over"] += len(list(work.iterdir())) - 1
            shutil.rmtree(work)
    return found


def _make_crashed_journal(folder: Path, seed: int) -> None:
    """Create the journal of a killed process, with a write-ahead log, gaps, and a sensor without measurements."""
    made = folder.with_name("making")
    made.mkdir()
    with Journal.create(made / "rec.h5.journal", target="rec.h5", source="kills") as journal:
        for sensor in (*_SENSORS, "absent"):
            journal.add_sensor(sensor, _SETTINGS, firmware="1.2.3", translation_m=(1.0, 2.0, 3.0))
        for sequence in (1, 2, 3, 5, 6):
            for sensor in _SENSORS:
                stamp = Stamp(
                    sensor=sensor, sequence=sequence, sync_count=sequence, timestamp_ns=sequence, session_id=_SESSION_ID
                )
                words = _words(seed, sensor, sequence)
                journal.append([JournalEntry(Measurement(words, _SETTINGS, stamp), monotonic_ns=sequence)])
        journal.note_gap("left", 4, 4, "footer", session_id=_SESSION_ID)
        journal.note_gap("absent", 0, 6, "it was silent", session_id=_SESSION_ID)
        shutil.copytree(made, folder)  # Nothing is being written, so the copy equals the files after a kill.
    shutil.rmtree(made)


def _seal_undisturbed(nursery: "_Nursery", crashed: Path, work: Path) -> tuple[int, float, bytes]:
    """Seal without a kill, and return the number of lines, the duration, and the recording."""
    n_lines, lasts_s, made = 0, 0.0, b""
    for counts in (True, False):
        path = shutil.copytree(crashed, work) / "rec.h5.journal"
        nursery.begin("seal", path=str(path), counts_lines=counts)
        begin_s = time.monotonic()
        reported = nursery.end()
        lasts_s = time.monotonic() - begin_s
        n_lines = int(reported[-1]) if counts else n_lines
        made = (work / "rec.h5").read_bytes()
        shutil.rmtree(work)
    return n_lines, lasts_s, made


def _killed_sealing(nursery: "_Nursery", path: Path, rng: random.Random, n_lines: int, lasts_s: float) -> bool:
    """Kill a process while it seals, and return True if the kill came before its end."""
    if rng.random() < 0.5:
        nursery.begin("seal", path=str(path), dies_after_lines=rng.randrange(n_lines))
    else:
        nursery.begin("seal", path=str(path))
        time.sleep(rng.uniform(0.0, lasts_s))
        nursery.kill()
    return "sealed" not in nursery.end()


def _seal(*, path: str) -> None:
    from ertis_numba.storage.sealing import seal  # noqa: PLC0415  the processes that only append do without HDF5

    seal(path)
    _emit_event("sealed")


class _Nursery:
    """Process that forks others, after it has imported all modules."""

    def __enter__(self) -> Self:
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "SOURCE_DATE_EPOCH": "1700000000",  # Files are compared byte by byte.
        }
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.faults.kills"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        if self._process.stdin is None or self._process.stdout is None:
            raise RuntimeError("the nursery has no pipes")
        self._input: IO[str] = self._process.stdin
        self._output: IO[str] = self._process.stdout
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def begin(
        self, job: str, *, dies_after_lines: int | None = None, counts_lines: bool = False, **arguments: Any
    ) -> None:
        """Start a process.

        It may kill itself before a given line of code, or report the number of executed lines at its end.
        """
        self._ask({"job": job, "lines": dies_after_lines, "counts": counts_lines, "arguments": arguments})
        self._pid = int(self.line())

    def kill(self) -> None:
        """Kill the process.

        Its process id stays reserved until `end`, so that no other process can get the same id.
        """
        os.kill(self._pid, signal.SIGKILL)

    def end(self) -> list[str]:
        """Wait until the process has ended, and return the rest of its output."""
        self._ask({"job": None})
        return list(iter(self.line, "ended"))

    def line(self) -> str:
        """Return the next line of the process."""
        line = self._output.readline().rstrip("\n")
        if not line or line.startswith("failed"):
            raise RuntimeError(f"process to be killed failed: {line or 'no output'}")
        return line

    def _ask(self, request: dict[str, Any]) -> None:
        self._input.write(json.dumps(request) + "\n")
        self._input.flush()


def _run_nursery() -> None:
    """Start and end processes according to requests on stdin."""
    pid = 0
    for line in sys.stdin:
        request = json.loads(line)
        if request["job"] is None:
            os.waitpid(pid, 0)
            _emit_event("ended")
            continue
        if request["job"] == "seal":
            import ertis_numba.storage.sealing  # noqa: F401, PLC0415  so that the copies need not
        pid = os.fork()
        if not pid:
            _run_job(request)


def _run_job(request: dict[str, Any]) -> NoReturn:
    """Run a job until it ends or the process is killed."""
    signal.alarm(_LIFE_S)
    _emit_event(str(os.getpid()))
    try:
        counter = _LineCounter(request["lines"])
        if request["lines"] is not None or request["counts"]:
            sys.settrace(counter)
        jobs: dict[str, Callable[..., None]] = {"append": _append, "seal": _seal}
        jobs[request["job"]](**request["arguments"])
        sys.settrace(None)
        if request["counts"]:
            _emit_event(str(counter.count))
    except BaseException as error:  # noqa: BLE001  whatever it is, the one who asked has to hear of it
        traceback.print_exc()
        _emit_event(f"failed: {' '.join(str(error).split())}")
    finally:
        os._exit(0)


class _LineCounter:
    """Trace function that counts executed lines of this package, and kills the process before a given line."""

    def __init__(self, largest: int | None) -> None:
        self.count = 0
        self._max = largest

    def __call__(self, frame: FrameType, _event: str, _argument: object) -> Callable[..., Any] | None:
        """Trace a called function if it belongs to this package."""
        return self._line if frame.f_code.co_filename.startswith(_OURS) else None

    def _line(self, _frame: FrameType, event: str, _argument: object) -> Callable[..., Any]:
        self.count += event == "line"
        if self._max is not None and self.count > self._max:
            os.kill(os.getpid(), signal.SIGKILL)
        return self._line


def _emit_event(line: str) -> None:
    os.write(1, f"{line}\n".encode())  # A single write makes the line atomic and immediate.


if __name__ == "__main__":
    _run_nursery()
