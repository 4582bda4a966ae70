"""Random damage to every kind of file. Each reader must report all data that is lost or changed.

``python -m tests.faults.flips FOLDER STATE...`` makes files of several kinds, each in a process that ends by SIGKILL,
and prints the measurements that were reported as stored. The reference reader uses only h5py and zlib.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import traceback
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from ertis_numba.base.errors import ErtisError
from ertis_numba.frames import Measurement, SequenceGap, Stamp
from ertis_numba.journal import SUFFIX, Journal, JournalEntry, JournalSensor
from ertis_numba.journal._tables import insert_statement
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.central_node._ledger import Ledger
from ertis_numba.network.central_node._received_items import SensorSession
from ertis_numba.network.keys import KeyPair, public_key
from ertis_numba.network.sensor_node._disk_spool import DiskSpool
from ertis_numba.settings import Recording, Settings

__all__ = ["flips"]

_SETTINGS: Final = Settings(recording=Recording(n_samples=4_096))
_LONG: Final = Settings(recording=Recording(n_samples=32_768))
"""Settings of measurements for large files, which take less time to check than as many bytes in short ones."""
_SESSION_ID: Final = 7
_SENSORS: Final = ("left", "right")
_BLOCK_BYTES: Final = 512
_OTHER_AT_EACH_SEALING: Final = {"/@date_created", "/@history"}

Judge = Callable[[Path], str]
"""Function that returns "harmless", "noticed", "silent" or "crashed" for a damaged copy of a state."""

Shown = set[tuple[str, int, int]]
"""Sensor, sequence number and CRC-32 of measurements that a process has reported as stored."""


@dataclass(frozen=True, slots=True)
class _Kind:
    """Files of one kind: their state, their names, and their share of all trials."""

    state: str
    pattern: str
    share: float


_KINDS: Final = {
    "journal": _Kind("grown", f"*{SUFFIX}", 0.18),
    "log of a journal": _Kind("young", f"*{SUFFIX}-wal", 0.22),
    "log of a grown journal": _Kind("grown", f"*{SUFFIX}-wal", 0.06),
    "rollback journal": _Kind("large", f"*{SUFFIX}-journal", 0.04),
    "spool": _Kind("spool", f"*{SUFFIX}*", 0.14),
    "ledger": _Kind("ledger", ".ertis-ledger", 0.08),
    "recording": _Kind("recording", "*.h5", 0.16),
    "keys": _Kind("keys", "robot.*.toml", 0.06),
    "allow list": _Kind("keys", "allow.toml", 0.06),
}


def flips(folder: Path, *, seed: int, count: int, only: str = "") -> dict[str, Any]:
    """Damage files ``count`` times.

    One trial in ten zeroes a block, one in ten truncates a file, and the others flip a bit.

    Returns
    -------
    dict
        Totals ``tried``, ``noticed``, ``harmless``, ``silent`` and ``crashed``. ``kinds`` has the same counts per kind.
    """
    rng = random.Random(seed)
    kinds: dict[str, dict[str, int]] = {}
    judges: dict[str, Judge] = {}
    chosen = {name: kind for name, kind in _KINDS.items() if not only or only == name}
    shown = _make_states(folder, {kind.state for kind in chosen.values()})
    for name, kind in chosen.items():
        made = folder / kind.state
        if kind.state not in judges:
            judges[kind.state] = _STATES[kind.state](made, shown[kind.state])
        counts: Counter[str] = Counter()
        for _ in range(max(1, round(count * kind.share))):
            work = shutil.copytree(made, folder / "work")
            what = _damage(rng.choice(sorted(work.glob(kind.pattern))), rng)
            verdict = judges[kind.state](work)
            counts[verdict] += 1
            if verdict in {"silent", "crashed"}:
                sys.stderr.write(f"{name}: {verdict}: {what}\n")
            shutil.rmtree(work)
        kinds[name] = {"tried": counts.total(), **{key: counts[key] for key in _VERDICTS}}
    return {key: sum(each[key] for each in kinds.values()) for key in ("tried", *_VERDICTS)} | {
        "kinds": kinds,
        "each": ", ".join(f"{name} {each['tried']:,}" for name, each in kinds.items()),
    }


_VERDICTS: Final = ("noticed", "harmless", "silent", "crashed")


def _damage(path: Path, rng: random.Random) -> str:
    """Damage a file, and return a description of the damage."""
    content = bytearray(path.read_bytes())
    place = rng.randrange(len(content))
    how = rng.random()
    if how < 0.1:
        content[place : place + _BLOCK_BYTES] = bytes(len(content[place : place + _BLOCK_BYTES]))
    elif how < 0.2:
        del content[place:]
    else:
        content[place] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    return f"{path.name}, {'block' if how < 0.1 else 'end' if how < 0.2 else 'bit'} at {place}"


def _classify(read: Callable[[], tuple[object, bool]], wanted: object) -> str:
    """Classify the content that was read, together with the errors that were reported."""
    try:
        found, reported = read()
    except ErtisError as error:
        return "noticed" if str(error) and "\n" not in str(error) else "crashed"
    except Exception as error:  # noqa: BLE001  a traceback in the face of a user
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        return "crashed"
    if reported:
        return "noticed"
    return "harmless" if found == wanted else "silent"


# States


def _make_states(folder: Path, states: Iterable[str]) -> dict[str, Shown]:
    """Create states, each in a process that is then killed, and return the measurements that these reported."""
    command = [sys.executable, "-m", "tests.faults.flips", str(folder), *sorted(states)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"process that makes {command[4:]} ended with {done.returncode}: {done.stderr[-500:]}")
    shown: dict[str, Shown] = {state: set() for state in states}
    for state, *measurement in map(json.loads, done.stdout.splitlines()):
        shown[state].add(tuple(measurement))
    return shown


def _journal(state: str) -> Callable[[Path, Shown], Judge]:
    def make(folder: Path, shown: Shown) -> Judge:
        from ertis_numba.storage.sealing import seal  # noqa: PLC0415  the processes to be killed do without HDF5
        from ertis_numba.storage.verify import verify  # noqa: PLC0415

        whole = shutil.copytree(folder, folder.with_name(f"{state}-whole"))
        seal(whole / f"rec.h5{SUFFIX}")
        wanted = _content(whole / "rec.h5")
        if shown != _measured(whole / "rec.h5"):
            raise RuntimeError(f"undamaged journal ({state}) differs from the reported measurements")

        def read(work: Path) -> tuple[object, bool]:
            sealed = seal(work / f"rec.h5{SUFFIX}")
            if sealed.recording is None:
                return None, False
            reported = bool(sealed.remark) or not all(report.is_intact for report in verify(sealed.recording))
            return _content(sealed.recording), reported

        return lambda work: _classify(lambda: read(work), wanted)

    return make


def _recording(folder: Path, _: Shown) -> Judge:
    from ertis_numba.storage.sealing import seal  # noqa: PLC0415
    from ertis_numba.storage.verify import verify  # noqa: PLC0415

    seal(folder / f"rec.h5{SUFFIX}")
    wanted = _content(folder / "rec.h5")

    def read(work: Path) -> tuple[object, bool]:
        reported = not all(report.is_intact for report in verify(work / "rec.h5"))
        return (None if reported else _content(work / "rec.h5")), reported

    return lambda work: _classify(lambda: read(work), wanted)


def _spool(_: Path, shown: Shown) -> Judge:
    def read(work: Path) -> tuple[object, bool]:
        notes: list[str] = []
        spool = DiskSpool(work, 10**9, None, on_note=notes.append)
        spool.open()
        found, is_gap = set(), False
        for run in spool.runs.values():
            for item in run.items:
                entry = spool.entry(item, run)
                if entry is None:
                    is_gap = True
                else:
                    found.add((run.sensor.name, item.first, zlib.crc32(entry.measurement.data.tobytes())))
        spool.close()
        # Discarded measurements may come back, because the central node recognises them.
        return found >= shown, bool(notes) or is_gap

    return lambda work: _classify(lambda: read(work), wanted=True)


def _ledger(folder: Path, _: Shown) -> Judge:
    whole = Ledger(folder)
    wanted = (whole.acked_through, whole.open, whole.unsealed, whole.gaps)

    def read(work: Path) -> tuple[object, bool]:
        ledger = Ledger(work)
        if any(last > whole.acked_through.get(run, -1) for run, last in ledger.acked_through.items()):
            return None, False  # The node would take later measurements for stored.
        return (ledger.acked_through, ledger.open, ledger.unsealed, ledger.gaps), bool(ledger.damage)

    return lambda work: _classify(lambda: read(work), wanted)


def _keys(folder: Path, _: Shown) -> Judge:
    def read(work: Path) -> tuple[object, bool]:
        work.chmod(0o700)
        pair = KeyPair.load(work / "robot.secret.toml")
        return (pair, public_key(work / "robot.public.toml"), AllowList.load(work / "allow.toml")), False

    wanted = read(folder)[0]
    return lambda work: _classify(lambda: read(work), wanted)


_STATES: Final[dict[str, Callable[[Path, Shown], Judge]]] = {
    **{state: _journal(state) for state in ("young", "grown", "large")},
    "recording": _recording,
    "spool": _spool,
    "ledger": _ledger,
    "keys": _keys,
}


# Reference reader


def _measured(path: Path) -> Shown:
    """Return sensor, sequence number and CRC-32 of the words of all measurements in a recording."""
    with h5py.File(path) as file:
        return {
            (name, int(number), zlib.crc32(np.ascontiguousarray(words).tobytes()))
            for name, group in file["sensors"].items()
            for number, words in zip(group["sequence"][:], group["pdm"], strict=True)
        }


def _content(path: Path) -> dict[str, object]:
    """Return all attributes and arrays of a file, except those that differ between two sealings."""
    found: dict[str, object] = {}
    with h5py.File(path) as file:
        names = ["/"]
        file.visit(names.append)
        for name in names:
            item = file[name]
            found[name] = "" if isinstance(item, h5py.Group) else (item.shape, str(item.dtype), item[()].tobytes())
            for key in item.attrs:
                found[f"{name}@{key}"] = _attribute(file, item.attrs[key], key)
    return {key: value for key, value in found.items() if key not in _OTHER_AT_EACH_SEALING}


def _attribute(file: h5py.File, value: Any, key: str) -> object:
    if key == "DIMENSION_LIST":
        return [[file[each].name for each in axis] for axis in value]
    if key == "REFERENCE_LIST":
        return [(file[each].name, int(axis)) for each, axis in value]
    return np.asarray(value).tobytes() if not isinstance(value, str) else value


# Processes that are killed


def _entries(count: int, settings: Settings = _SETTINGS) -> Iterator[JournalEntry]:
    for number in range(count):
        for sensor in _SENSORS:
            words = np.random.default_rng([number, _SENSORS.index(sensor)]).integers(
                0, 2**32, settings.recording.n_samples, dtype=np.uint32
            )
            stamp = Stamp(sensor=sensor, sequence=number, session_id=_SESSION_ID, timestamp_ns=1_000_000_007 * number)
            yield JournalEntry(Measurement(words, settings, stamp), monotonic_ns=number)


def _emit_event(state: str, entries: list[JournalEntry]) -> None:
    for entry in entries:
        stamp = entry.measurement.stamp
        sys.stdout.write(json.dumps([state, stamp.sensor, stamp.sequence, entry.crc32]) + "\n")
    sys.stdout.flush()


def _begin_another_commit(journal: Journal) -> None:
    """Change pages that a rollback journal restores."""
    execute = journal._database.execute  # noqa: SLF001  nobody else can be killed in mid commit
    execute("PRAGMA cache_size = 1")  # Pages that exceed the cache are written before the commit.
    execute("BEGIN")
    execute("UPDATE measurements SET crc32 = 0 WHERE id % 9 = 1")
    for number in range(60):
        execute(insert_statement("measurements"), (1, _SESSION_ID, 10_000 + number, *[0] * 10, bytes(8192)))


def _make_files(state: str, folder: Path) -> None:
    """Make the files of a state."""
    if state in {"young", "recording", "grown", "large"}:
        journal = Journal.create(folder / f"rec.h5{SUFFIX}", target="rec.h5", source="flips")
        settings = _LONG if state in {"grown", "large"} else _SETTINGS
        for sensor in _SENSORS:
            journal.add_sensor(sensor, settings, firmware="1.2.3")
        entries = list(_entries({"grown": 19, "large": 20}.get(state, 12), settings))
        size = len(entries) if state == "large" else 1
        for begin in range(0, len(entries), size):
            journal.append(entries[begin : begin + size])
            _emit_event(state, entries[begin : begin + size])
        if state == "large":
            _begin_another_commit(journal)
    elif state == "spool":
        spool = DiskSpool(folder, 10**9, None, on_note=lambda _: None)
        spool.open()
        for sensor in _SENSORS:
            spool.add_sensor(JournalSensor.from_settings(sensor, _SETTINGS))
        entries = list(_entries(20))
        for entry in entries:
            spool.append([entry])
        _emit_event(state, entries)
    elif state == "ledger":
        runs = {
            SensorSession(sensor, 2**40 + session_id): 1_000 * session_id
            for session_id in range(8)
            for sensor in _SENSORS
        }
        gaps = [SequenceGap("left", 3, 9, "the spool was full", 5)]
        tails = {run: {last - number: last * number for number in range(16)} for run, last in runs.items()}
        Ledger(folder).save(runs, open_=["a.h5.journal"], unsealed=["b.h5.journal"], gaps=gaps, tails=tails)
    else:
        pair = KeyPair.new("robot")
        pair.save(folder / "made")
        serials = ("front", "left", "right")
        robot = Permission(name="robot", public=pair.public, role="sensor", serials=serials)
        viewer = Permission(name="viewer", public=KeyPair.new("viewer").public, role="application")
        AllowList(keys=(robot, viewer)).save(folder / "allow.toml")
        for path in (folder / "made").iterdir():
            path.rename(folder / path.name)
        (folder / "made").rmdir()


def _make_and_die(state: str, folder: Path) -> None:
    """Make the files of a state in a process that ends by SIGKILL; raise an error if it ends otherwise."""
    folder.mkdir()
    pid = os.fork()
    if pid == 0:
        try:
            _make_files(state, folder)
            os.kill(os.getpid(), signal.SIGKILL)
        finally:
            traceback.print_exc()
            os._exit(1)
    _, status = os.waitpid(pid, 0)
    if os.waitstatus_to_exitcode(status) != -signal.SIGKILL:
        raise RuntimeError(f"process that makes {state!r} ended with status {status}")


if __name__ == "__main__":
    for each in sys.argv[2:]:
        _make_and_die(each, Path(sys.argv[1]) / each)
