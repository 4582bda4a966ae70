"""Trials of hostile hello messages to a central node, and of hostile files with commands that read them."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from ertis_bench.network.processes import JsonLinesProcess, central, until
from ertis_bench.network.sender import SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network_trials.oracle import judged

from ertis_numba.base.errors import DataError
from ertis_numba.network import messages
from tests.faults.network.hostile_hellos import HostileHello, hostile_hellos
from tests.faults.network.zmtp import ZmtpPeer

__all__ = ["files", "hellos"]

_WAIT_S: Final = 20.0
Found = dict[str, Any]


def hellos(folder: Path, *, seed: int, count: int | None = None, alone_s: float = 3.0, rate_hz: float = 20.0) -> Found:
    """Send hostile hello messages to a central node that stores and processes, while a sensor sends to it.

    Parameters
    ----------
    folder : Path
    seed : int
        Seed of the words.
    count : int, optional
        Maximum number of hello messages, spread evenly over all of them.
    alone_s : float
        Duration of the reference measurement of the sensor's acknowledgements, before the first hello message.
    rate_hz : float
        Rate of the sensor.

    Returns
    -------
    dict
        ``hellos`` that were sent, and ``taken`` ones among them; the slowest refusal; the largest growth of the memory
        of the central node and its workers; the slowest acknowledgement during the trial and before it; and the results
        for the measurements.
    """
    archive, diary = folder / "recordings", folder / "sender.ndjson"
    archive.mkdir()
    with ExitStack() as stack:
        options = ("--publish", "tcp://127.0.0.1:*", "--record", str(archive), "--directions", "2d:9", "--workers", "1")
        node = stack.enter_context(central("serve", folder, *options))
        listening = node.wait_for("listening")
        job = SenderJob(address=listening["address"], diary=str(diary), rate_hz=rate_hz, seed=seed)
        sender = stack.enter_context(job.start())
        until(lambda: diary.exists() and len(read_diaries([diary]).acked()) > rate_hz)
        alone_ns = time.monotonic_ns()
        time.sleep(alone_s)
        begun_ns, before = time.monotonic_ns(), _peak_bytes(node, reset=True)
        refused = _refused(listening["address"], _spread(list(hostile_hellos()), count))
        ended_ns, grew = time.monotonic_ns(), _peak_bytes(node) - before
        time.sleep(0.5)  # time for the last acknowledgements to arrive
        sender.signal(signal.SIGTERM)
        flushed = sender.wait_for("sent")["flushed"]
        code = node.stop()
    slowest = max(refused, key=lambda each: each["took_s"])
    return {
        "hellos": len(refused),
        "taken": [each["name"] for each in refused if not each["refused"]],
        "slowest refusal, s": slowest["took_s"],
        "slowest refused": slowest["name"],
        "memory grew, MB": round(grew / 1e6, 1),
        "slowest ack, ms": _slowest_ms(diary, begun_ns, ended_ns),
        "slowest ack alone, ms": _slowest_ms(diary, alone_ns, begun_ns),
        "flushed": flushed,
        "exit code": code,
    } | judged(folder, archive, [diary])


def _spread(given: list[HostileHello], count: int | None) -> list[HostileHello]:
    """Return at most ``count`` hello messages, spread evenly."""
    step = 1.0 if count is None else max(1.0, len(given) / count)
    return [given[int(place * step)] for place in range(int(len(given) / step))]


def _refused(address: str, given: Sequence[HostileHello]) -> list[Found]:
    """Send hello messages one after the other, and return the result of each."""
    found: list[Found] = []
    with ZmtpPeer(address, timeout_s=_WAIT_S) as peer:
        for hello in given:
            begun_s = time.monotonic()
            peer.send([hello.header, *hello.payload])
            try:
                answer = messages.decode(peer.receive()[0])
            except OSError as error:
                raise DataError(f"central node does not answer hello {hello.name!r} ({error})") from error
            took_s = round(time.monotonic() - begun_s, 3)
            found.append({"name": hello.name, "took_s": took_s, "refused": isinstance(answer, messages.Refused)})
    return found


def _slowest_ms(diary: Path, begin_ns: int, end_ns: int) -> float:
    """Return the slowest acknowledgement of measurements that arrived between two monotonic times, in ms."""
    sent = read_diaries([diary])
    times_ns = [
        acked_ns - sent.arrived_ns[key]
        for key, acked_ns in sent.acked_ns.items()
        if begin_ns <= sent.arrived_ns[key] < end_ns
    ]
    return round(max(times_ns, default=0) / 1e6, 1)


def _peak_bytes(node: JsonLinesProcess, *, reset: bool = False) -> int:
    """Return the peak memory of a process and its children since the last reset, or 0 if it is unknown."""
    total = 0
    for pid in (node.pid, *_children(node.pid)):
        with contextlib.suppress(OSError):
            folder = Path(f"/proc/{pid}")
            if reset:
                (folder / "clear_refs").write_text("5")
            lines = (folder / "status").read_text("ascii").splitlines()
            total += sum(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    return total


def _children(pid: int) -> list[int]:
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found += [int(child) for child in path.read_text("ascii").split()]
    return found


def files(folder: Path, *, count: int | None = None) -> Found:
    """Let `ertis verify`, `info` and `process` read hostile files, each in a process whose memory is measured.

    Parameters
    ----------
    folder : Path
    count : int, optional
        Maximum number of files, spread evenly over all of them.

    Returns
    -------
    dict
        ``files``; ``reads`` of them; reads that were ``taken``, or that ``failed`` with a traceback; ``crashes``; and
        the maximum time and memory of a read.
    """
    options = [] if count is None else [f"--count={count}"]
    command = [sys.executable, "-m", "tests.faults.network.hostile_reads", str(folder), *options]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=3600.0)
    if ran.returncode:
        raise DataError(f"hostile files could not be tried; {(ran.stderr.strip().splitlines() or ['no output'])[-1]}")
    found: Found = json.loads(ran.stdout)
    return found
