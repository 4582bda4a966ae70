"""Trials with killed nodes of a network.

No measurement that was acknowledged, or kept in a spool, may be lost or stored twice.
"""

import os
import random
import secrets
import signal
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Final

from ertis_bench.network.processes import ERTIS, JsonLinesProcess, central, survivors, until
from ertis_bench.network.sender import SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network_trials.oracle import judged

from ertis_numba.base.errors import DataError
from tests.faults.network.self_kill import in_trap
from tests.faults.network.sender_thread import SenderThread
from tests.ports import reserved_address

__all__ = ["RestartedRecorder", "centrals", "nodes", "sealings"]

_CHILDREN_END_S: Final = 30.0  # time limit for children of a killed process to end
_SEARCH_INTERVAL_S: Final = 0.05  # between two searches for processes, each of which reads a file of every process
_ROTATE_MB: Final = 16
_LINES_TO_LISTEN: Final = 2_500  # approximate lines of code that a central node runs until it listens
_LINES_TO_BEGIN: Final = 1_000  # approximate lines of code that a sensor node runs until it sends
_LINES_OF_A_LIFE: Final = 12_000  # approximate lines of code that either runs in a second
_SEALING: Final = "-m ertis_numba.storage.sealing_process"  # in the command line of a sealing process
_N_KEPT: Final = 20  # measurements that a sensor node keeps before it is killed at a random time
_LIFE_S: Final = 1.0  # lifetime of a process that does not reach its line
_RING_BYTES: Final = 500_000_000
Found = dict[str, Any]


class RestartedRecorder:
    """``ertis record`` that is restarted repeatedly, at one address and with one folder.

    Parameters
    ----------
    folder : Path
        Folder of the trial. Recordings go to its subfolder ``recordings``.
    *options : str

    Attributes
    ----------
    archive : Path
    address : str
    mark : str
        Mark by which all processes are found that the command has started.
    """

    def __init__(self, folder: Path, *options: str, archive: Path | None = None) -> None:
        self.folder, self._options = folder, options
        self.archive = archive or folder / "recordings"
        self.archive.mkdir(exist_ok=True)
        self._reserved = reserved_address()  # until this object is deleted
        self.address, self.mark = self._reserved.__enter__(), secrets.token_hex(8)

    def start(self, ertis: Sequence[str] = ERTIS) -> JsonLinesProcess:
        """Start the command, or a variant of it, without waiting until it listens."""
        options = ("-o", str(self.archive), *self._options)
        return central("record", self.folder, *options, listen=self.address, mark=self.mark, ertis=ertis)

    def finish(self, senders: Sequence[JsonLinesProcess | SenderThread] = (), *, timeout_s: float = 120.0) -> Found:
        """Wait until senders have sent all measurements and these are sealed; start the command again if necessary.

        Returns
        -------
        dict
            ``unacked``, number of senders with unacknowledged measurements; ``orphans``, processes that should have
            ended.
        """
        unacked = 0
        if not senders:
            ended = until(lambda: not survivors(self.mark), timeout_s=_CHILDREN_END_S, every_s=_SEARCH_INTERVAL_S)
            if ended and not list(self.archive.glob("*.journal*")):
                return {"unacked": 0, "orphans": 0}
        with self.start() as last:
            last.wait_for("listening")
            for sender in senders:
                sender.signal(signal.SIGTERM)
            for sender in senders:
                unacked += not sender.wait_for("sent", timeout_s=timeout_s)["flushed"]
                sender.wait()
            code = last.stop(timeout_s=timeout_s)
            if code:
                raise DataError(f"ertis record ended with {code}; {last.last_words()}")
        until(lambda: not survivors(self.mark), timeout_s=_CHILDREN_END_S, every_s=_SEARCH_INTERVAL_S)
        return {"unacked": unacked, "orphans": len(survivors(self.mark))}


def centrals(folder: Path, *, seed: int, count: int, rate_hz: float) -> Found:
    """Kill a central node while two sensors send to it, also while it starts, rotates and seals.

    Half of the kills come at a random time, the others before a random line of code. Measurements from times without a
    central node must be sent while it runs. The long trials therefore use a lower sensor rate.
    """
    rng = random.Random(seed)
    record = RestartedRecorder(folder, "--rotate-size", str(_ROTATE_MB))
    diary, by_line = folder / "sender.ndjson", 0
    job = SenderJob(address=record.address, diary=str(diary), sensors=("left", "right"), rate_hz=rate_hz, seed=seed)
    with SenderThread(job.replace(ring_bytes=_RING_BYTES, patience_s=60.0)) as sender:
        sender.wait_for("begun")
        for _ in range(count):
            max_lines = _some_lines(rng, _LINES_TO_LISTEN, _LINES_OF_A_LIFE) if rng.random() < 0.5 else None
            with record.start(in_trap(max_lines, ERTIS)) as node:
                if max_lines is not None:
                    by_line += until(lambda node=node: _killed_itself(node), timeout_s=_LIFE_S)  # type: ignore[misc]
                else:
                    if rng.random() < 0.8:  # The other processes are killed while they start.
                        node.wait_for("listening")
                    time.sleep(rng.uniform(0.0, 0.5))
                node.kill()
        ended = record.finish([sender])
    return {"kills": count, "before a line": by_line} | ended | judged(folder, record.archive, [diary])


def _killed_itself(node: JsonLinesProcess) -> bool:
    """Return True if a central node was killed before a line, so that it has ended or was restarted."""
    return not node.running or node.restarts > 0


def _some_lines(rng: random.Random, n_first: int, n_more: int) -> int:
    """Return the number of lines before a kill. One third of the kills come while the process starts."""
    return rng.randrange(n_first) if rng.random() < 1 / 3 else n_first + rng.randrange(n_more)


def nodes(folder: Path, *, seed: int, count: int) -> Found:
    """Kill two sensor nodes, one of them with a spool on disk. The node with a spool may lose nothing.

    Every other pair is killed before a random line of code, the others at a random time while they send.
    """
    rng = random.Random(seed)
    record = RestartedRecorder(folder, "--rotate-size", str(_ROTATE_MB))
    diaries = {name: folder / f"{name}.ndjson" for name in ("spool", "memory")}
    jobs = {
        name: SenderJob(
            address=record.address, diary=str(diary), sensors=(name,), rate_hz=100.0, seed=seed, patience_s=60.0
        )
        for name, diary in diaries.items()
    }
    jobs["spool"] = jobs["spool"].replace(spool=str(folder / "spool"))
    (folder / "spool").mkdir()
    by_line = 0
    with record.start() as node:
        node.wait_for("listening")
        for number in range((count + 1) // 2):
            with ExitStack() as stack:
                lines = _some_lines(rng, _LINES_TO_BEGIN, _LINES_OF_A_LIFE) if number % 2 else None
                n_before = {name: _n_kept(diary) for name, diary in diaries.items()}
                senders = [stack.enter_context(job.start(in_trap(lines, job.command()))) for job in jobs.values()]
                if lines is None:
                    until(
                        lambda n_before=n_before: all(  # type: ignore[misc]
                            _n_kept(diaries[name]) >= n + _N_KEPT for name, n in n_before.items()
                        )
                    )
                for sender in rng.sample(senders, 2):
                    if lines is not None:
                        by_line += sender.ends_within(_LIFE_S)
                    else:
                        time.sleep(rng.uniform(0.0, 0.3))
                    sender.kill()
        node.stop()
    with SenderThread(jobs["spool"].replace(count=1)) as last:
        last.wait_for("done")
        ended = record.finish([last])
    found = judged(folder, record.archive, list(diaries.values()), kept=[diaries["spool"]])
    return (
        {"kills": 2 * ((count + 1) // 2), "before a line": by_line}
        | ended
        | found
        | {"in_spool": len(list((folder / "spool").iterdir()))}
    )


def _n_kept(diary: Path) -> int:
    return len(read_diaries([diary]).kept) if diary.exists() else 0


def sealings(folder: Path, *, seed: int, count: int, rate_hz: float = 20.0) -> Found:
    """Kill sealing processes while the central node continues, and sometimes the central node with them.

    The rate of the sensor determines how often a sealing process starts.
    """
    rng = random.Random(seed)
    record = RestartedRecorder(folder, "--rotate-size", "2")
    diary = folder / "sender.ndjson"
    job = SenderJob(address=record.address, diary=str(diary), rate_hz=rate_hz, seed=seed, ring_bytes=_RING_BYTES)
    killed = with_central = 0
    with ExitStack() as stack:
        sender = stack.enter_context(SenderThread(job.replace(patience_s=60.0)))
        node = stack.enter_context(record.start())
        seen: set[int] = set()
        while killed < count:
            sealers = [pid for pid, line in survivors(record.mark).items() if _SEALING in line]
            fresh = [pid for pid in sealers if pid not in seen]
            if not fresh:
                if not node.running:
                    raise DataError(f"central node has ended; {node.last_words()}")
                time.sleep(_SEARCH_INTERVAL_S)
                continue
            seen.update(fresh)
            if rng.random() < 0.5:  # The others are killed after they have begun to write.
                time.sleep(rng.uniform(0.0, 0.4))
            else:
                writes = partial(_writes, record.archive, fresh[0])
                until(writes, every_s=0.002)
                time.sleep(rng.uniform(0.0, 0.03))
            killed += _killed(fresh[0])
            if rng.random() < 0.2:
                node.kill()
                with_central += 1
                node = stack.enter_context(record.start())
        node.stop()
        ended = record.finish([sender])
    return {"kills": killed, "with central": with_central} | ended | judged(folder, record.archive, [diary])


def _writes(archive: Path, pid: int) -> bool:
    """Return True if a sealing process has begun to write a recording, or has ended."""
    return any(archive.glob("*.part")) or not Path(f"/proc/{pid}/cmdline").exists()


def _killed(pid: int) -> bool:
    """Kill a process, and return True if it was still running."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True
