"""Trials with hostile connections and malformed messages, which the central node must refuse."""

import contextlib
import random
import resource
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from ertis_bench.network.processes import JsonLinesProcess, central, until
from ertis_bench.network.sender import SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network_trials.oracle import judged

from tests.faults.network.fuzz import inputs
from tests.faults.network.kills import RestartedRecorder
from tests.faults.network.links import state_of
from tests.faults.network.sender_thread import SenderThread
from tests.faults.network.zmtp import GREETING, ZmtpPeer, greeting, host_and_port, message, ready

__all__ = ["fuzzed", "hostile"]

_BATCH: Final = 1000
_HEADER_BYTES: Final = 4096
_HUGE_BYTES: Final = 2**40
Found = dict[str, Any]


def fuzzed(folder: Path, *, seed: int, count: int) -> Found:
    """Send malformed and hostile messages to both addresses of a central node, while a sensor sends to it.

    Returns
    -------
    dict
        ``inputs``, sent messages, and ``answers`` to them; ``closed``, number of closed connections; ``restarts`` of
        its processes; and the results for the sensor's measurements.
    """
    archive, diary = folder / "recordings", folder / "sender.ndjson"
    archive.mkdir()
    found: Found = {"inputs": 0, "answers": 0, "closed": 0}
    with ExitStack() as stack:
        options = ("--publish", "tcp://127.0.0.1:*", "--record", str(archive), "--directions", "2d:9", "--workers", "1")
        node = stack.enter_context(central("serve", folder, *options))
        listening = node.wait_for("listening")
        job = SenderJob(address=listening["address"], diary=str(diary), rate_hz=10.0, seed=seed)
        sender = stack.enter_context(SenderThread(job))
        until(lambda: diary.exists() and bool(read_diaries([diary]).acked()))
        before = node.memory_bytes
        rng = random.Random(seed)
        _send_all(listening["address"], rng, count - count // 5, found)
        _send_all(listening["publish"], rng, count // 5, found, max_bytes=_HEADER_BYTES)
        found["memory grew, MB"] = round((node.memory_bytes - before) / 1e6, 1)
        status = state_of(listening["address"])
        processing = status["processing"]
        found["restarts"] = processing["respawned"] + processing["publisher_respawned"]
        found["state"], found["turned away"] = status["state"], sum(status["refused"].values())
        sender.signal(signal.SIGTERM)
        found["flushed"] = sender.wait_for("sent")["flushed"]
        found["exit code"] = node.stop()
    return found | judged(folder, archive, [diary])


def _send_all(address: str, rng: random.Random, count: int, found: Found, *, max_bytes: int | None = None) -> None:
    """Send inputs.

    Frames longer than ``max_bytes`` are truncated, because the other side would close the connection.
    """
    for batch in inputs(rng, count, _BATCH):
        for attempt in range(3):
            try:
                with ZmtpPeer(address) as peer:
                    peer.send(*([frame[:max_bytes] for frame in frames] for frames in batch))
                    peer.send([b"nothing at all"])
                    peer.socket.settimeout(0.02 if attempt else 0.3)
                    with contextlib.suppress(TimeoutError):
                        while peer.receive():
                            found["answers"] += 1
                break
            except OSError:
                found["closed"] += 1
        found["inputs"] += len(batch)


def hostile(folder: Path, *, seed: int, count: int, rate_hz: float = 20.0) -> Found:
    """Open hostile connections while a sensor sends. They are silent, send garbage, send too much, or send too slowly.

    Returns
    -------
    dict
        ``connections``, and the largest number of them ``at once``; the slowest acknowledgement; the growth of the
        memory; and the results for the sensor's measurements.
    """
    record = RestartedRecorder(folder)
    diary = folder / "sender.ndjson"
    job = SenderJob(address=record.address, diary=str(diary), rate_hz=rate_hz, seed=seed, small=False)
    max_memory = 0
    with ExitStack() as stack:
        node = stack.enter_context(record.start())
        node.wait_for("listening")
        sender = stack.enter_context(job.start())
        until(lambda: diary.exists() and len(read_diaries([diary]).acked()) > rate_hz)
        before = node.memory_bytes
        with _crowd(record.address, seed, count) as crowd:
            end_s = time.monotonic() + max(4.0, count / 50)  # Slow handshakes are closed after three seconds.
            while time.monotonic() < end_s:
                crowd.whisper()
                max_memory = max(max_memory, node.memory_bytes)
                time.sleep(0.1)
            opened = crowd.opened
        sender.signal(signal.SIGTERM)
        flushed = sender.wait_for("sent")["flushed"]
        sent = read_diaries([diary])
        ended = record_ended(node, record)
    times_ms = sent.ack_times_ms()
    return (
        {
            "connections": opened,
            "flushed": flushed,
            "slowest ack, ms": round(times_ms[-1], 1),
            "memory grew, MB": round((max_memory - before) / 1e6, 1),
        }
        | ended
        | judged(folder, record.archive, [diary])
    )


def record_ended(node: JsonLinesProcess, record: RestartedRecorder) -> Found:
    """Stop a central node, and check for remaining processes and tracebacks."""
    return {"exit code": node.stop()} | record.finish()


class _Crowd:
    """Set of hostile connections."""

    def __init__(self, address: str, seed: int) -> None:
        self._address, self._rng = address, random.Random(seed)
        self._sockets: list[socket.socket] = []
        self._slow: list[socket.socket] = []
        self._kinds: list[Callable[[socket.socket], None]] = [
            lambda _: None,
            self._garbage,
            lambda each: each.sendall(b"GET / HTTP/1.1\r\nHost: here\r\n\r\n"),
            lambda each: each.sendall(GREETING[:10]),
            lambda each: each.sendall(GREETING),
            self._slow.append,
            lambda each: each.sendall(greeting(b"CURVE") + bytes(200)),
            lambda each: each.sendall(greeting(b"PLAIN") + ready()),
            lambda each: each.sendall(GREETING + ready(identity=b"front")),
            lambda each: each.sendall(GREETING + ready(b"REP")),
            lambda each: each.sendall(GREETING + ready() + b"\x02" + _HUGE_BYTES.to_bytes(8, "big") + bytes(50_000)),
            lambda each: each.sendall(GREETING + ready() + message([bytes(3_000_000)])),
            lambda each: each.sendall(GREETING + ready() + message([b""] * 2000)),
            lambda each: each.sendall(GREETING + ready() + b"\x04\xff" + bytes(255)),
            lambda each: each.close(),
        ]
        self.opened = 0

    def join(self, count: int) -> None:
        """Open connections, each with a different kind of hostile behaviour."""
        for number in range(count):
            each = socket.socket()
            each.settimeout(1.0)
            self._sockets.append(each)
            with contextlib.suppress(OSError):
                each.connect(host_and_port(self._address))
                self.opened += 1
                self._kinds[number % len(self._kinds)](each)

    def whisper(self) -> None:
        """Continue handshakes that never end."""
        for each in self._slow:
            with contextlib.suppress(OSError):
                each.sendall(b"\xff")

    def _garbage(self, each: socket.socket) -> None:
        each.sendall(self._rng.randbytes(self._rng.randrange(1, 20_000)))

    def leave(self) -> None:
        """Close all connections."""
        for each in self._sockets:
            each.close()


@contextmanager
def _crowd(address: str, seed: int, count: int) -> Iterator[_Crowd]:
    """Yield hostile connections, which open during the block and close at its end."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, max(soft, count + 500)), hard))
    crowd = _Crowd(address, seed)
    thread = threading.Thread(target=crowd.join, args=(count,))
    thread.start()
    try:
        yield crowd
    finally:
        thread.join()
        crowd.leave()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
