"""Trials below the protocol: bits flipped in encrypted connections, and nodes that end while their messages wait."""

import contextlib
import os
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

from ertis_bench.network.processes import until
from ertis_bench.network.sender import SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network_trials.oracle import judged

from ertis_numba.base.errors import DataError, ErtisError
from ertis_numba.network.central_client import CentralClient
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.subscriber import Subscriber
from tests.faults.network.busy import BUSY_ERTIS, BUSY_S
from tests.faults.network.keyed_node import KeyedNode
from tests.faults.network.kills import RestartedRecorder
from tests.faults.network.meddler import Direction, Meddler
from tests.faults.network.sender_thread import SenderThread

__all__ = ["flip_bits", "flips", "gone"]

_SHARE_TO_CLIENT: Final = 0.1  # share of flips on the way to a client, which needs three seconds to detect one
_FLIPPED_S: Final = 60.0
_N_VICTIMS: Final = 5  # sensor nodes that are killed together
_WINDOW: Final = 16  # measurements that a node may have under way
_FILL_WINDOW_S: Final = 1.0  # time limit until the window is full
_RATE_HZ: Final = 20.0
_RING_BYTES: Final = 500_000_000
_N_CONNECTIONS: Final = 4  # connections to each port
Found = dict[str, Any]


def flips(folder: Path, *, seed: int, count: int) -> Found:
    """Flip bits in the encrypted connections of a sensor and of an application, while both are served.

    Returns
    -------
    dict
        Results of `flip_bits`, and the results for the sensor's measurements.
    """
    with KeyedNode.running(folder) as keyed:
        found, diary = flip_bits(keyed, folder, seed=seed, count=count)
        code = keyed.node.stop()
    return found | {"exit code": code} | judged(folder, keyed.archive, [diary])


def flip_bits(keyed: KeyedNode, folder: Path, *, seed: int, count: int) -> tuple[Found, Path]:
    """Flip bits in the encrypted connections of a running node, and return the results and the sensor's diary.

    Returns
    -------
    dict
        ``flips``; ``restarts`` of the central node or its publisher; ``sockets left``, open sockets of both after the
        clients have ended.
    diary : Path
    """
    rng, diary = random.Random(seed), folder / "sender.ndjson"
    node = keyed.node
    pids = [node.node_pid, keyed.status()["processing"]["publisher_pid"]]
    before = [_tcp_sockets(pid) for pid in pids]
    with ExitStack() as clients:
        cables = [
            clients.enter_context(Meddler(address, seed=rng.randrange(2**32)))
            for address in (keyed.address, keyed.publish) * _N_CONNECTIONS
        ]
        job = SenderJob(
            address=cables[0].address, diary=str(diary), rate_hz=_RATE_HZ, seed=seed, ring_bytes=_RING_BYTES
        )
        key = str(keyed.keys / "front.secret.toml")
        sender = clients.enter_context(SenderThread(job.replace(keys=(key, keyed.server))))
        clients.enter_context(_repeating(partial(_watch, cables[1].address, keyed.client("viewer"))))
        for cable in cables[2:]:
            clients.enter_context(_repeating(partial(_ask, cable.address, keyed.client("boss"))))
        sender.wait_for("begun")
        with ThreadPoolExecutor(len(cables)) as pool:
            shares = [len(range(number, count, len(cables))) for number in range(len(cables))]
            rngs = [random.Random(rng.random()) for _ in cables]
            list(pool.map(_flip, cables, rngs, shares))
        sender.signal(signal.SIGTERM)
        flushed = sender.wait_for("sent", timeout_s=120.0)["flushed"]
    until(lambda: all(_tcp_sockets(pid) <= n for pid, n in zip(pids, before, strict=True)))
    left = sum(_tcp_sockets(pid) for pid in pids) - sum(before)
    restarts = node.restarts + keyed.status()["processing"]["publisher_respawned"]
    flipped = sum(sum(cable.did.values()) for cable in cables)
    return {"flips": flipped, "flushed": flushed, "restarts": restarts, "sockets left": max(0, left)}, diary


def _flip(cable: Meddler, rng: random.Random, count: int) -> None:
    """Flip bits in a cable, one at a time.

    Raises
    ------
    DataError
        The cable carries no more messages.
    """
    for number in range(count):
        direction: Direction = "from target" if rng.random() < _SHARE_TO_CLIENT else "to target"
        cable.flip(direction)
        if not until(lambda number=number: sum(cable.did.values()) > number, timeout_s=_FLIPPED_S):  # type: ignore[misc]
            raise DataError(f"no message passes {cable.address} after {number} flips")


@contextmanager
def _repeating(turn: Callable[[threading.Event], None]) -> Iterator[None]:
    """Repeat a function until the block ends, even if connections fail."""
    ended = threading.Event()

    def run() -> None:
        while not ended.is_set():
            with contextlib.suppress(ErtisError):
                turn(ended)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _watch(address: str, keys: ClientKeys, ended: threading.Event) -> None:
    """Receive images."""
    with Subscriber(address, products=("energyscape",), keys=keys) as images:
        while not ended.is_set():
            images.receive(timeout_s=0.1)


def _ask(address: str, keys: ClientKeys, ended: threading.Event) -> None:
    """Request the status."""
    with CentralClient(address, keys=keys) as client:
        while not ended.wait(0.02):
            client.status(patience_s=0.5)


def _tcp_sockets(pid: int) -> int:
    """Return the number of open TCP sockets of a process, including sockets of ended connections; Linux only.

    A process that has ended has none.
    """
    links = set()
    with contextlib.suppress(FileNotFoundError):
        for each in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):  # The socket was closed meanwhile.
                links.add(str(each.readlink()))
    local = {f"socket:[{line.split()[6]}]" for line in Path("/proc/net/unix").read_text().splitlines()[1:]}
    return sum(link.startswith("socket:") for link in links - local)


def gone(folder: Path, *, seed: int, count: int) -> Found:
    """Kill sensor nodes with measurements under way while the central node is behind with reading.

    Returns
    -------
    dict
        ``kills``; ``restarts`` of the central node; ``sockets left``; and the results for the measurements of an
        undisturbed node and of the killed nodes.
    """
    record = RestartedRecorder(folder)
    steady = folder / "steady.ndjson"
    job = SenderJob(
        address=record.address, diary=str(steady), rate_hz=10.0, seed=seed, patience_s=60.0, ring_bytes=_RING_BYTES
    )
    diaries = [steady]
    with ExitStack() as stack:
        node = stack.enter_context(record.start(BUSY_ERTIS))
        node.wait_for("listening")
        pid, before = node.node_pid, _tcp_sockets(node.node_pid)
        sender = stack.enter_context(SenderThread(job))
        sender.wait_for("begun")
        for first in range(0, count, _N_VICTIMS):
            victims = [folder / f"victim{number}.ndjson" for number in range(first, min(count, first + _N_VICTIMS))]
            diaries += victims
            _kill_while_behind(node.node_pid, job, victims)
        until(lambda: _all_acked(steady, at_minimum=1))
        restarts = node.restarts
        sender.signal(signal.SIGTERM)
        flushed = sender.wait_for("sent", timeout_s=120.0)["flushed"]
        sender.wait()
        until(lambda: _tcp_sockets(pid) <= before)
        left = _tcp_sockets(pid) - before if restarts == 0 else 0
        code = node.stop()
    ended = record.finish()
    found = {"kills": len(diaries) - 1, "restarts": restarts, "sockets left": max(0, left), "flushed": flushed}
    return found | {"exit code": code} | ended | judged(folder, record.archive, diaries, kept=[steady])


def _kill_while_behind(pid: int, job: SenderJob, diaries: list[Path]) -> None:
    """Block the event loop of the central node, let nodes send until their windows are full, and kill them."""
    with ExitStack() as stack:
        victims = [
            stack.enter_context(
                job.replace(diary=str(diary), sensors=(diary.stem,), rate_hz=100.0, ring_bytes=None).start()
            )
            for diary in diaries
        ]
        until(lambda: all(_all_acked(diary, at_minimum=1) for diary in diaries))
        begun_s = time.monotonic()
        os.kill(pid, signal.SIGUSR1)
        until(lambda: all(_n_waiting(diary) > _WINDOW for diary in diaries), timeout_s=_FILL_WINDOW_S)
        for victim in victims:
            victim.kill()
        time.sleep(max(0.0, begun_s + BUSY_S - time.monotonic()))


def _n_waiting(diary: Path) -> int:
    """Return the number of measurements that a node has accepted and that are not acknowledged."""
    sent = read_diaries([diary])
    return len(sent.kept - sent.acked())


def _all_acked(diary: Path, *, at_minimum: int) -> bool:
    return diary.exists() and len(read_diaries([diary]).acked()) >= at_minimum
