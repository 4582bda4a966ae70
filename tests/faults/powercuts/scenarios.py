"""Commands that run on a disk whose operations are all logged."""

import json
import random
import signal
import sys
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from ertis_bench.network.diary import DiaryKey, Row
from ertis_bench.network.processes import ERTIS, JsonLinesProcess
from ertis_bench.network.sender import SenderJob
from ertis_bench.network.sent import Sent, note

from ertis_numba.base.errors import DataError
from tests.faults import captures
from tests.faults.powercuts.log import DiskOperation, DiskRecord, environment
from tests.ports import reserved_address

__all__ = ["AcknowledgedState", "Fail", "Setting", "Trace", "capture", "central", "journal", "spool"]

Fail = tuple[int, int, int] | None
"""Failing syncs: index of the first, number, and seed."""

_PATIENCE_S: Final = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Place and options of a command.

    Attributes
    ----------
    folder : Path
        Empty folder for this run only.
    disk_log : Path
    seed : int
    count : int
        Measurements of each sensor.
    fail : Fail
    """

    folder: Path
    disk_log: Path
    seed: int
    count: int
    fail: Fail = None

    @property
    def disk(self) -> Path:
        """Logged folder."""
        return self.folder / "disk"

    @property
    def log(self) -> Path:
        """File of the log."""
        return self.folder / "log"

    def preloaded(self, command: list[str], *, acks: Path | None = None, fail: Fail = None) -> list[str]:
        """Return a command that runs with the log."""
        chosen = environment(self.disk_log, self.disk, self.log, acks=acks, fail=fail)
        names = [name for name in chosen if name.startswith(("POWERCUT_", "LD_PRELOAD"))]
        return ["env", *(f"{name}={chosen[name]}" for name in names), *command]


@dataclass(slots=True)
class AcknowledgedState:
    """Measurements that were acknowledged up to a record of a log.

    Attributes
    ----------
    sent : Sent
    """

    sent: Sent = field(default_factory=Sent)
    _lines: dict[int, bytes] = field(default_factory=dict)

    def take(self, record: DiskRecord) -> None:
        """Apply the next record."""
        if record.kind is not DiskOperation.ACK:
            return
        *lines, self._lines[record.pid] = (self._lines.get(record.pid, b"") + record.data).split(b"\n")
        for line in lines:
            try:
                reported = json.loads(line)
            except ValueError:
                continue
            if isinstance(reported, list):
                note(self.sent, *reported)
            elif reported.get("event") == "stored" and "crc32" in reported:
                key = DiaryKey(reported["sensor"], reported["session_id"], reported["sequence"])
                self.sent.offered[key] = Row(reported["crc32"], reported["sync_count"], reported["timestamp_ns"])
                self.sent.kept.add(key)
            elif reported.get("event") == "discarded":  # Discarded measurements need not be stored from now on.
                self.sent.kept = {key for key in self.sent.kept if key.sequence > reported["sequence"]}


@dataclass(frozen=True, slots=True, kw_only=True)
class Trace:
    """Finished run of a command.

    Attributes
    ----------
    setting : Setting
    sent_crc32 : set of int, optional
        CRC-32 of the measured words. With None, words are not compared.
    """

    setting: Setting
    sent_crc32: AbstractSet[int] | None = None


def capture(setting: Setting, source: Path) -> Trace:
    """Run ``ertis capture -o`` with an emulated sensor."""
    setting.disk.mkdir()
    with captures.emulated(source, setting.folder) as ports:
        command = [*ERTIS, "capture", "--port", ports[0], "-o", str(setting.disk / "rec.h5"), "--json", "--quiet"]
        command += ["--rate", "20", "-n", str(setting.count)]
        with _process(setting, setting.preloaded(command, fail=setting.fail)) as process:
            code = process.wait()
            if code and setting.fail is None:
                raise DataError(f"ertis capture ended with {code}; {process.last_words()}")
    sent = captures.sent_by_emulators(setting.folder)
    return Trace(setting=setting, sent_crc32=frozenset(crc32 for _, crc32 in sent))


def journal(setting: Setting) -> Trace:
    """Run a process that only appends to a journal."""
    setting.disk.mkdir()
    command = [sys.executable, "-m", "tests.faults.powercuts.writer", str(setting.disk), str(setting.seed)]
    command = setting.preloaded([*command, str(setting.count)], fail=setting.fail)
    with _process(setting, command) as process:
        code = process.wait()
        if code and setting.fail is None:
            raise DataError(f"journal writer ended with {code}; {process.last_words()}")
    return Trace(setting=setting)


def _process(setting: Setting, command: list[str], name: str = "said") -> JsonLinesProcess:
    return JsonLinesProcess(command, stated=setting.folder / f"{name}.txt")


def central(setting: Setting, command: str) -> Trace:
    """Run ``ertis record`` or ``ertis serve --record`` while two sensors send to it."""
    setting.disk.mkdir()
    diary = setting.folder / "sender.ndjson"
    option = "-o" if command == "record" else "--record"
    listen = "tcp://127.0.0.1:*"
    line = [*ERTIS, command, "--listen", listen, option, str(setting.disk / "recordings"), "--rotate-size", "4"]
    if command == "serve":
        line += ["--publish", listen, "--workers", "1"]
    line = setting.preloaded([*line, "--json", "--quiet"], acks=setting.folder / "none", fail=setting.fail)
    with _process(setting, line, "central") as node:
        job = _job(setting, node.wait_for("listening")["address"], diary, sensors=("left", "right"))
        with _process(setting, setting.preloaded(job.command(), acks=diary), "sender") as sender:
            flushed = sender.wait_for("sent")["flushed"]
            sender.wait()
        node.signal(signal.SIGTERM)
        code = node.wait()
    if setting.fail is None and (code or not flushed):
        raise DataError(f"ertis {command} ended with {code}; all measurements acknowledged: {flushed}")
    return Trace(setting=setting)


def _job(setting: Setting, address: str, diary: Path, **options: Any) -> SenderJob:
    rate_hz = random.Random(setting.seed).choice((20.0, 50.0, 200.0))
    chosen = {"seed": setting.seed, "count": setting.count, "rate_hz": rate_hz, "patience_s": _PATIENCE_S}
    return SenderJob(address=address, diary=str(diary), **chosen | options)


def spool(setting: Setting) -> Trace:
    """Run a sensor node with a spool, first without a central node and then with one."""
    setting.disk.mkdir()
    with reserved_address() as address:
        _spool_at(setting, address)
    return Trace(setting=setting)


def _spool_at(setting: Setting, address: str) -> None:
    diary = setting.folder / "sender.ndjson"
    job = _job(setting, address, diary, spool=str(setting.disk / "spool"))
    recordings = setting.folder / "recordings"
    record = [*ERTIS, "record", "--listen", address, "-o", str(recordings), "--json", "--quiet"]
    with _process(setting, setting.preloaded(job.command(), acks=diary, fail=setting.fail), "sender") as sender:
        sender.wait_for("begun")
        with _process(setting, record, "central") as node:
            node.wait_for("listening")
            sender.wait_for("sent")
            sender.wait()
            node.signal(signal.SIGTERM)
            node.wait()
