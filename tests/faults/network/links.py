"""Trials with full or failing disks, absent central nodes, and messages that are lost."""

import json
import os
import resource
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from click.testing import CliRunner
from ertis_bench.network.processes import JsonLinesProcess, until
from ertis_bench.network.sender import SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network_trials.oracle import judged
from ertis_cli.main import cli

from ertis_numba.base.errors import DataError
from tests.faults.network.kills import RestartedRecorder
from tests.faults.network.meddler import ACKS, Meddler
from tests.faults.network.sender_thread import SenderThread

__all__ = ["away", "disk_fails", "disk_full", "meddled", "state_of"]

_RING_BYTES: Final = 64_000_000
_MARGIN_BYTES: Final = 24_000_000  # margin above a full ring, for other memory of a process
_START_S: Final = 2.0  # time limit until a node listens and sensors are connected to it
_FAULT_S: Final = 1.5  # time in which a node with a failing disk must not acknowledge
_STEADY_S: Final = 60.0  # time limit until such a node stores nothing more
_MEDDLED_S: Final = 60.0  # time limit for each effect on acknowledgements to occur
_ALL_EFFECTS: Final = {"ack lose", "ack repeat", "ack delay"}
Found = dict[str, Any]


def state_of(address: str, *keys: str) -> dict[str, Any]:
    """Return the status of a central node, as ``ertis sensors status --json`` prints it.

    Raises
    ------
    DataError
        The node does not answer.
    """
    done = CliRunner().invoke(cli, ["sensors", "status", address, "--json", "--once", *keys])
    if done.exit_code:
        raise DataError(f"ertis sensors status ended with {done.exit_code}: {done.stderr.strip()}")
    status: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return status


def disk_full(folder: Path, disk: Path, *, seed: int) -> Found:
    """Fill a small disk while a sensor sends, and free it again.

    Count measurements that were acknowledged meanwhile, and lost measurements. Both counts must be 0.
    """
    ballast = disk / "ballast"
    archive = disk / "recordings"
    archive.mkdir()

    def free() -> None:
        ballast.unlink()

    ballast.write_bytes(bytes(9_000_000))
    return _send_through_fault(folder, RestartedRecorder(folder, archive=archive), free, seed=seed, count=25)


def disk_fails(folder: Path, *, seed: int) -> Found:
    """Let each write beyond a position in a file fail, as with EIO, and allow writes again.

    The counts are those of `disk_full`.
    """
    record = RestartedRecorder(folder)
    return _send_through_fault(folder, record, None, seed=seed)


def _send_through_fault(
    folder: Path, record: RestartedRecorder, free: Callable[[], None] | None, *, seed: int, count: int | None = None
) -> Found:
    """Send until the disk fails, repair it, and send the remaining measurements.

    Parameters
    ----------
    free : callable, optional
        Repairs the disk. By default, a kernel limit makes writes of the process fail beyond about 100 kB of a file, and
        the repair removes the limit.
    count : int, optional
        Number of measurements. By default, the sensor measures until the disk is repaired.
    """
    diary = folder / "sender.ndjson"
    job = SenderJob(address=record.address, diary=str(diary), rate_hz=20.0, count=count, seed=seed, patience_s=60.0)
    job = job.replace(ring_bytes=10 * _RING_BYTES)
    with ExitStack() as stack:
        node = stack.enter_context(record.start())
        node.wait_for("listening")
        sender = stack.enter_context(SenderThread(job))
        sender.wait_for("begun")
        if free is None:
            until(lambda: bool(read_diaries([diary]).acked()))
            _limit(node, 100_000)
        fault = node.wait_for("fault")
        acked, acked_in_fault, state = _acked_in_fault(record.address, job.sensors[0], diary)
        n_events = len(node.events)
        if free is None:
            _limit(node, resource.RLIM_INFINITY)
        else:
            free()
        node.wait_for("resumed", since=n_events)
        if count is None:
            sender.signal(signal.SIGTERM)
        sender.wait_for("sent")
        node.stop()
        ended = record.finish()
    return {
        "state": state,
        "said": " ".join(str(fault.get("text", fault.get("reason", ""))).split()).replace(str(record.archive), "DISK"),
        "acked before": acked,
        "acked in fault": acked_in_fault,
        **ended,
        **judged(folder, record.archive, [diary]),
    }


def _acked_in_fault(address: str, sensor: str, diary: Path) -> tuple[int, int, str]:
    """Count acknowledgements while a node stores nothing. A nearly full disk may still store a few measurements.

    Returns
    -------
    before, meanwhile : int
        Acknowledged measurements: those that were stored before, and others.
    state : str
        State of the node at the end.
    """
    end_s = time.monotonic() + _STEADY_S
    status = state_of(address)
    while True:
        stored = status["sensors"][sensor]["stored"]
        until(lambda stored=stored: len(read_diaries([diary]).acked()) >= stored)  # type: ignore[misc]
        time.sleep(_FAULT_S)
        status = state_of(address)
        if status["sensors"][sensor]["stored"] == stored or time.monotonic() > end_s:
            return stored, len(read_diaries([diary]).acked()) - stored, status["state"]


def _limit(process: JsonLinesProcess, max_bytes: int) -> None:
    """Make writes beyond a position in any file fail with EFBIG, which SQLite treats as a disk error."""
    resource.prlimit(process.node_pid, resource.RLIMIT_FSIZE, (max_bytes, resource.RLIM_INFINITY))


def away(folder: Path, *, seed: int, away_s: float, how: str) -> Found:
    """Stop a central node for a while, first within the capacity of a ring in memory, then beyond it.

    Parameters
    ----------
    how : {"killed", "stopped"}
        ``killed`` ends the process. ``stopped`` suspends it, so that its connections stay open.
    """
    record = RestartedRecorder(folder)
    diary = folder / "sender.ndjson"
    rate_hz = 0.7 * _RING_BYTES / (131_072 * (away_s + _START_S))
    job = SenderJob(address=record.address, diary=str(diary), seed=seed, ring_bytes=_RING_BYTES, patience_s=60.0)
    found: Found = {"away_s": away_s}
    with ExitStack() as stack:
        node = stack.enter_context(record.start())
        node.wait_for("listening")
        for name, factor in (("", 1.0), (" too long", 2.5)):
            sender = stack.enter_context(job.replace(rate_hz=factor * rate_hz).start())
            sender.wait_for("begun")
            until(lambda: bool(read_diaries([diary]).acked()))
            before = sender.memory_bytes
            if how == "killed":
                node.kill()
            else:
                os.kill(node.node_pid, signal.SIGSTOP)
            time.sleep(away_s)
            found[f"memory grew{name}, MB"] = round((sender.memory_bytes - before) / 1e6, 1)
            if how == "killed":
                node = stack.enter_context(record.start())
                node.wait_for("listening")
            else:
                os.kill(node.node_pid, signal.SIGCONT)
            back_s = time.monotonic()
            acked = len(read_diaries([diary]).acked())
            until(lambda acked=acked: len(read_diaries([diary]).acked()) > acked)  # type: ignore[misc]
            found[f"back after{name}, s"] = round(time.monotonic() - back_s, 2)
            sender.signal(signal.SIGTERM)
            sender.wait_for("sent", timeout_s=120.0)
            sender.wait()
            if not name:
                node.stop()
                found |= {name: n for name, n in judged(folder, record.archive, [diary]).items() if name != "left_over"}
                node = stack.enter_context(record.start())
                node.wait_for("listening")
        node.stop()
        ended = record.finish()
    overrun = judged(folder, record.archive, [diary])
    return (
        found
        | ended
        | {"left_over": overrun["left_over"], "most memory, MB": (_RING_BYTES + _MARGIN_BYTES) / 1e6}
        | {f"{name} too long": overrun[name] for name in ("lost", "missing", "wrong", "twice", "unexpected", "silent")}
    )


def meddled(folder: Path, *, seed: int, duration_s: float) -> Found:
    """Lose, repeat and delay acknowledgements, drop connections, and unplug the cable without notice to either end."""
    record = RestartedRecorder(folder)
    diary = folder / "sender.ndjson"
    with ExitStack() as stack:
        node = stack.enter_context(record.start())
        node.wait_for("listening")
        cable = stack.enter_context(Meddler(record.address, seed=seed, odds=ACKS))
        job = SenderJob(address=cable.address, diary=str(diary), rate_hz=40.0, seed=seed, ring_bytes=10 * _RING_BYTES)
        sender = stack.enter_context(SenderThread(job.replace(sensors=("left", "right"), patience_s=60.0)))
        sender.wait_for("begun")
        end_s = time.monotonic() + duration_s
        drops = cuts = 0
        while time.monotonic() < end_s:
            time.sleep(duration_s / 8)
            cable.drop()
            drops += 1
            time.sleep(duration_s / 8)
            cable.cut()
            cuts += 1
            time.sleep(min(5.0, duration_s / 4))
            cable.mend()
        until(lambda: cable.did.keys() >= _ALL_EFFECTS, timeout_s=_MEDDLED_S)
        sender.signal(signal.SIGTERM)
        flushed = sender.wait_for("sent", timeout_s=120.0)["flushed"]
        node.stop()
        ended = record.finish()
        did = dict(cable.did)
    return (
        {"drops": drops, "cuts": cuts, "flushed": flushed, "meddled": did}
        | ended
        | judged(folder, record.archive, [diary])
    )
