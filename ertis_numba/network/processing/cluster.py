"""Jobs on the workers of a dask cluster that is there already, for more than one machine."""

import os
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from ertis_numba.cluster import Future, connect
from ertis_numba.network.processing import _cluster_worker as there
from ertis_numba.network.processing.notes import Prepared
from ertis_numba.network.processing.options import Options
from ertis_numba.network.processing.runner import Done, Event, Job, Kind, KindFailed, KindReady, Lost, bytes_of
from ertis_numba.network.processing.slots import Slot
from ertis_numba.network.status import WorkerStatus
from ertis_numba.network.waker import Waker

__all__ = ["Cluster"]

_CONNECT_S: Final = 10.0
_LOOK_S: Final = 1.0


@dataclass(slots=True, eq=False)
class _Attempt:
    """A job on its way, and where its image is to go."""

    job: Job
    slot: Slot
    deadline_s: float
    future: Future = None
    given_up: bool = False


@dataclass(slots=True)
class _Member:
    """A worker of the cluster."""

    threads: int
    pid: int = 0
    done: int = 0


@dataclass(slots=True, eq=False)
class _Readying:
    """A kind that workers get ready for."""

    kind: Kind
    futures: list[Future] = field(default_factory=list)
    asked: set[str] = field(default_factory=set)


class Cluster:
    """A `Runner` whose jobs run on the workers of a dask scheduler.

    Pipelines stay in the processes of these workers, which need this package, of the same version. As many jobs are
    under way as all workers together have threads. Dask starts what a lost worker had once more on another; what is
    not done by the deadline is given up. Whoever reaches a scheduler can run code on its workers: keep it among
    machines that trust each other, or use dask's TLS.

    Parameters
    ----------
    options : Options
        Its deadline, device and type of images count, and ``cluster``, the scheduler's address.
    log : callable
        Called with lines about what happens.

    Attributes
    ----------
    choice : str
    respawned : int
        Workers that have left.

    Raises
    ------
    DeviceError
        dask.distributed is not installed.
    NetworkError
        No scheduler answers.
    """

    def __init__(self, options: Options, log: Callable[[str], None]) -> None:
        self._options, self._log = options, log
        self._address = options.cluster or ""
        self._run = secrets.token_hex(4)
        self._client = connect(self._address, timeout_s=_CONNECT_S)
        self._events: deque[tuple[Any, ...]] = deque()
        self._waker = Waker()
        self._members: dict[str, _Member] = {}
        self._readying: dict[int, _Readying] = {}
        self._prepared: dict[int, Prepared] = {}
        self._attempts: dict[int, _Attempt] = {}
        self._free: list[Slot] = []
        self._n_slots = self._n_attempts = self._n_asked = 0
        self.respawned = 0
        self._closing = threading.Event()
        self._looker = threading.Thread(target=self._look, name="cluster", daemon=True)
        self._looker.start()

    @property
    def choice(self) -> str:
        """How measurements share the cluster."""
        workers, threads = len(self._members), self._n_threads
        return f"up to {threads} at a time on {workers} workers of the cluster at {self._address}"

    @property
    def _n_threads(self) -> int:
        return sum(member.threads for member in self._members.values())

    def prepare(self, kind: Kind) -> None:
        """See `Runner`."""
        self._readying[kind.number] = _Readying(kind)
        self._ask_to_prepare()

    def _ask_to_prepare(self) -> None:
        """Let each worker that has not been asked get ready for each kind."""
        for kind, readying in self._readying.items():
            for address in self._members.keys() - readying.asked:
                readying.asked.add(address)
                self._n_asked += 1
                future = self._client.submit(
                    there.prepare,
                    kind,
                    readying.kind.settings,
                    self._options.device,
                    workers=[address],
                    allow_other_workers=False,
                    key=f"ertis-{self._run}-prepare-{kind}-{self._n_asked}",
                    pure=False,
                )
                readying.futures.append(future)
                future.add_done_callback(lambda done, kind=kind: self._tell("prepared", kind, *_result_of(done)))

    def forget(self, kind: Kind) -> None:
        """See `Runner`."""
        self._prepared.pop(kind.number, None)
        if (readying := self._readying.pop(kind.number, None)) is not None:
            self._cancel(readying.futures)

    def takes(self, kind: Kind) -> bool:
        """See `Runner`."""
        return kind.number in self._prepared and len(self._attempts) < self._n_threads

    def submit(self, job: Job) -> None:
        """See `Runner`."""
        self._n_attempts += 1
        number = self._n_attempts
        attempt = _Attempt(job, self._slot_for(job), time.monotonic() + self._options.deadline_s)
        self._attempts[number] = attempt
        attempt.future = self._client.submit(
            there.process,
            job.kind.settings,
            self._options.device,
            self._options.dtype,
            bytes(bytes_of(job.words)),
            points=job.points,
            key=f"ertis-{self._run}-{number}",
            pure=False,
        )
        attempt.future.add_done_callback(lambda done: self._tell("made", number, *_taken(done, attempt.slot)))

    def _slot_for(self, job: Job) -> Slot:
        """Return a slot that is large enough, with the measurement in it, for whoever wants it raw."""
        shape = self._prepared[job.kind.number].shape
        image_bytes = int(np.prod(shape)) * np.dtype(self._options.dtype).itemsize
        words_bytes = job.words.nbytes
        for slot in self._free:
            if slot.holds(words_bytes, image_bytes):
                self._free.remove(slot)
                break
        else:
            slot = Slot(self._n_slots, words_bytes, image_bytes)
            self._n_slots += 1
        slot.view.words(words_bytes)[:] = bytes_of(job.words)
        return slot

    def give_back(self, slot: Slot) -> None:
        """See `Runner`."""
        self._free.append(slot)

    def fds(self) -> Iterable[int]:
        """See `Runner`."""
        return [self._waker.fileno()]

    def ready(self, fd: int) -> Sequence[Event]:
        """See `Runner`."""
        if fd == self._waker.fileno():
            self._waker.clear()
        return self._heard()

    def tick(self, now_s: float, rate_hz: float) -> Sequence[Event]:  # noqa: ARG002  the load is the cluster's matter
        """See `Runner`."""
        found = self._heard()
        for attempt in self._attempts.values():
            if now_s > attempt.deadline_s and not attempt.given_up:
                attempt.given_up = True  # it keeps its slot until nobody writes there any more
                found.append(Lost(attempt.job, "it was not done in time", again=True))
                if attempt.future is not None:
                    self._cancel([attempt.future])
        return found

    def _cancel(self, futures: list[Future]) -> None:
        """Let go of tasks, without waiting for the scheduler."""
        self._client.loop.add_callback(lambda: self._client.cancel(futures, asynchronous=True, force=True))

    def status(self) -> list[WorkerStatus]:
        """See `Runner`."""
        busy = len(self._attempts)
        return [
            WorkerStatus(pid=member.pid, state="busy" if busy > place else "idle", done=member.done)
            for place, member in enumerate(self._members.values())
        ]

    def close(self) -> None:
        """See `Runner`."""
        self._closing.set()
        self._client.close(timeout=2)
        self._looker.join(_CONNECT_S)
        for slot in [*self._free, *(attempt.slot for attempt in self._attempts.values())]:
            slot.close()
        self._free.clear()
        self._attempts.clear()
        self._waker.close()

    def _look(self) -> None:
        """Follow which workers there are; in a thread of its own, as the scheduler may take its time."""
        known: dict[str, int] = {}
        while not self._closing.is_set():
            try:
                threads = {str(address): int(count) for address, count in self._client.nthreads().items()}
                new = [address for address in threads if address not in known]
                pids = self._client.run(os.getpid, workers=new, on_error="return") if new else {}
            except Exception as error:  # noqa: BLE001  whatever it is, it may pass
                if not self._closing.is_set():
                    self._tell("away", f"the scheduler at {self._address} does not answer ({type(error).__name__})")
            else:
                known = threads
                self._tell("members", threads, {name: pid for name, pid in pids.items() if isinstance(pid, int)})
            self._closing.wait(_LOOK_S)

    def _tell(self, *event: Any) -> None:
        """Hand something over to the loop; called in other threads."""
        self._events.append(event)
        self._waker.wake()

    def _heard(self) -> list[Event]:
        found: list[Event] = []
        while self._events:
            match self._events.popleft():
                case ("members", threads, pids):
                    self._follow(threads, pids)
                case ("away", text):
                    self._log(text)
                case ("prepared", kind, result, text):
                    found += self._became_ready(kind, result, text)
                case ("made", number, result, text):
                    found += self._finished(number, result, text)
        return found

    def _follow(self, threads: dict[str, int], pids: dict[str, int]) -> None:
        left = self._members.keys() - threads.keys()
        self.respawned += len(left)
        for address in left:
            self._log(f"worker {address} has left the cluster")
            del self._members[address]
        for address, count in threads.items():
            member = self._members.setdefault(address, _Member(count))
            member.threads, member.pid = count, pids.get(address, member.pid)
        self._ask_to_prepare()

    def _became_ready(self, kind: int, result: Any, text: str) -> list[Event]:
        if kind not in self._readying or kind in self._prepared:
            return []
        if isinstance(result, Prepared):
            self._prepared[kind] = result
            self._log(f"measurements are processed {self.choice}")
            return [KindReady(result)]
        if isinstance(result, str):  # a pipeline that no worker can make
            return [KindFailed(kind, result)]
        self._log(f"a worker of the cluster cannot get ready: {text}")
        return []

    def _finished(self, number: int, result: Any, text: str) -> list[Event]:
        attempt = self._attempts.pop(number)
        job, slot = attempt.job, attempt.slot
        if attempt.given_up:
            self._free.append(slot)
            return []
        if not isinstance(result, there.Made):
            self._free.append(slot)
            again = result is None
            return [Lost(job, text if again else str(result), again=again)]
        job.slot, job.n_points = slot, len(result.points)
        if (member := self._members.get(result.worker)) is not None:
            member.done += 1
        return [Done(job, result.took_s)]


def _taken(future: Future, slot: Slot) -> tuple[Any, str]:
    """Put what a task has made into a slot, or return why there is nothing; in a thread of the client."""
    made, text = _result_of(future)
    if isinstance(made, there.Made):
        np.copyto(slot.view.image_as(made.image.shape, made.image.dtype), made.image)
        slot.view.points(made.points.nbytes)[:] = made.points.tobytes()
        made = replace(made, image=made.image[:0])  # which is large, and not needed any more
    return made, text


def _result_of(future: Future) -> tuple[Any, str]:
    """Return what a task has come to, or None and why; in a thread of the client."""
    try:
        return future.result(timeout=_CONNECT_S), ""
    except (Exception, CancelledError) as error:  # noqa: BLE001  whatever it was, somebody waits to hear of it
        return None, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
