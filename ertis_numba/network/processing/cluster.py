"""Jobs on the workers of an existing dask cluster, for several machines."""

import asyncio
import itertools
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import numpy as np

from ertis_numba.network.processing import _cluster_worker as there
from ertis_numba.network.processing.options import ProcessingOptions
from ertis_numba.network.processing.parallelism import Load
from ertis_numba.network.processing.pipe_messages import Prepared
from ertis_numba.network.processing.runner import (
    Event,
    FinishedJob,
    Job,
    JobKind,
    KindFailed,
    KindReady,
    Lost,
    bytes_of,
)
from ertis_numba.network.processing.shared_slots import Slot, SlotPool
from ertis_numba.network.status import WorkerStatus
from ertis_numba.network.wakeup_socket import WakeupSocket
from ertis_numba.processes.cluster import RemoteError, WorkerActors, connect

__all__ = ["Cluster"]

_CONNECT_S: Final = 10.0
_POLL_INTERVAL_S: Final = 1.0


@dataclass(slots=True, eq=False)
class _Member:
    """Worker of the cluster, with the connection to it."""

    address: str
    line: Any
    pid: int
    threads: int
    asked: set[int] = field(default_factory=set)
    ready: set[int] = field(default_factory=set)
    busy: int = 0
    done: int = 0


@dataclass(slots=True, eq=False)
class _Attempt:
    """Job under way, with the slot for its image."""

    job: Job
    slot: Slot
    member: _Member


class Cluster:
    """`Runner` whose jobs run on the workers of a dask scheduler, at the address options.workers."""

    # More jobs per worker than threads took 30 ms each instead of 23 ms, at the same throughput. Anyone who reaches a
    # scheduler can run code on its workers.

    def __init__(self, options: ProcessingOptions, log: Callable[[str], None]) -> None:
        self._options, self._log = options, log
        self._address = str(options.workers)
        self._client = connect(self._address, timeout_s=_CONNECT_S)
        self._events: deque[tuple[Any, ...]] = deque()
        self._wakeup_socket = WakeupSocket()
        self._members: dict[str, _Member] = {}
        self._kinds: dict[int, JobKind] = {}
        self._prepared: dict[int, Prepared] = {}
        self._attempts: set[_Attempt] = set()
        self._slots = SlotPool(itertools.count())
        self.respawned = 0
        self._closing = threading.Event()
        self._looker = threading.Thread(target=self._look, name="cluster", daemon=True)
        self._looker.start()

    @property
    def choice(self) -> str:
        """Distribution of measurements over the cluster."""
        workers, threads = len(self._members), sum(member.threads for member in self._members.values())
        return f"up to {threads} at a time on {workers} workers of the cluster at {self._address}"

    def prepare(self, kind: JobKind) -> None:
        """Prepare for jobs of a kind; `KindReady` or `KindFailed` follows."""
        self.forget(kind)
        self._kinds[kind.number] = kind
        self._ask_to_prepare()

    def _ask_to_prepare(self) -> None:
        """Have each worker prepare each kind that it was not asked for."""
        for member in self._members.values():
            for kind in self._kinds.values():
                if kind.number not in member.asked:
                    member.asked.add(kind.number)
                    call = partial(there.prepare, kind.number, kind.settings, self._options.device, self._options.plan)
                    self._ask(member, call, self._options.prepare_s, "prepared", kind, member)

    def forget(self, kind: JobKind) -> None:
        """Release a kind, because no more jobs of it will come."""
        self._prepared.pop(kind.number, None)
        self._kinds.pop(kind.number, None)
        for member in self._members.values():
            member.asked.discard(kind.number)
            member.ready.discard(kind.number)

    def takes(self, kind: JobKind) -> bool:
        """Return True if a job of a kind can run now."""
        return kind.number in self._prepared and self._idle(kind) is not None

    def _idle(self, kind: JobKind) -> _Member | None:
        """Return the least busy worker that can run a job of a kind."""
        able = [each for each in self._members.values() if kind.number in each.ready and each.busy < each.threads]
        return min(able, key=lambda member: member.busy / member.threads, default=None)

    def submit(self, job: Job) -> None:
        """Run a job that `takes` accepts; `FinishedJob` or `Lost` follows."""
        if (member := self._idle(job.kind)) is None:
            raise AssertionError("a job was submitted that no worker can accept; call takes() first")
        attempt = _Attempt(job, self._slot_for(job), member)
        self._attempts.add(attempt)
        member.busy += 1
        call = partial(
            there.process,
            job.kind.settings,
            self._options.device,
            self._options.dtype,
            points=job.points,
            plan=self._options.plan,
        )
        deadline_s = self._options.deadline_s
        self._ask(member, call, deadline_s, "made", attempt, words=bytes_of(job.words), slot=attempt.slot)

    def _ask(
        self,
        member: _Member,
        call: "partial[Any]",
        within_s: float,
        *event: Any,
        words: memoryview | None = None,
        slot: Slot | None = None,
    ) -> None:
        """Call a function on a worker, with samples if given, and report the result; an image is copied into a slot."""
        # Samples are passed beside the call, because its own contents are copied.
        sent = () if words is None else (words,)

        async def ask() -> None:
            result, text = None, ""
            try:
                result = await asyncio.wait_for(member.line.call(call, *sent), within_s)
                if isinstance(result, there.ClusterResult) and slot is not None:
                    result = _kept(result, slot)
            except TimeoutError:
                text = "it missed the deadline"
            except Exception as error:  # noqa: BLE001  whatever it was, somebody waits to hear of it
                text = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
            self._emit_event(*event, result, text)

        self._client.loop.add_callback(ask)

    def _slot_for(self, job: Job) -> Slot:
        """Return a slot that is large enough, with the measurement in it for raw products."""
        shape = self._prepared[job.kind.number].shape
        image_bytes = int(np.prod(shape)) * np.dtype(self._options.dtype).itemsize
        words_bytes = job.words.nbytes
        slot = self._slots.take(words_bytes, image_bytes)
        assert slot is not None  # noqa: S101  there is no limit
        slot.view.words(words_bytes)[:] = bytes_of(job.words)
        return slot

    def release(self, slot: Slot) -> None:
        """Release the slot of a finished job."""
        self._slots.release(slot)

    def fds(self) -> Iterable[int]:
        """Return the descriptors to poll now."""
        return [self._wakeup_socket.fileno()]

    def ready(self, fd: int) -> Sequence[Event]:
        """Return new events, after a descriptor became readable."""
        if fd == self._wakeup_socket.fileno():
            self._wakeup_socket.clear()
        return self._heard()

    def tick(self, now_s: float, load: Load) -> Sequence[Event]:  # noqa: ARG002  time is the client's matter
        """Return new events; call it ten times a second with the load."""
        return self._heard()

    def status(self) -> list[WorkerStatus]:
        """Return the status of the workers."""
        members = self._members.values()
        return [WorkerStatus(pid=each.pid, state="busy" if each.busy else "idle", done=each.done) for each in members]

    def close(self) -> None:
        """Close everything."""
        self._closing.set()
        self._client.close(timeout=2)
        self._looker.join(_CONNECT_S)
        self._attempts.clear()
        self._slots.close()
        self._wakeup_socket.close()

    def _look(self) -> None:
        """Follow the list of workers, in a separate thread, because the scheduler may be slow."""
        lines = WorkerActors(self._client)
        while not self._closing.is_set():
            try:
                threads = {str(address): int(count) for address, count in self._client.nthreads().items()}
                reached = lines.connected(threads.keys() - set(self._members), timeout_s=_POLL_INTERVAL_S)
            except Exception as error:  # noqa: BLE001  whatever it is, it may pass
                if not self._closing.is_set():
                    self._emit_event(
                        "away", f"the scheduler at {self._address} does not answer ({type(error).__name__})"
                    )
            else:
                joined = [_Member(name, line, pid, threads[name]) for name, (line, pid) in reached.items()]
                self._emit_event("members", threads, joined)
            self._closing.wait(_POLL_INTERVAL_S)

    def _emit_event(self, *event: Any) -> None:
        """Pass an event to the loop; other threads call this."""
        self._events.append(event)
        self._wakeup_socket.wake()

    def _heard(self) -> list[Event]:
        found: list[Event] = []
        while self._events:
            match self._events.popleft():
                case ("members", threads, joined):
                    self._follow(threads, joined)
                case ("away", text):
                    self._log(text)
                case ("prepared", kind, member, result, text):
                    found += self._became_ready(kind, member, result, text)
                case ("made", attempt, result, text):
                    found.append(self._finished(attempt, result, text))
        return found

    def _follow(self, threads: dict[str, int], joined: list[_Member]) -> None:
        for member in [each for each in self._members.values() if each.address not in threads]:
            self._leave(member, "it has left the cluster")
        for member in joined:
            self._members.setdefault(member.address, member)
        for address, count in threads.items():
            if address in self._members:
                self._members[address].threads = count
        self._ask_to_prepare()

    def _leave(self, member: _Member, text: str) -> None:
        """Give a worker no more jobs until it is reached again."""
        if self._members.get(member.address) is member:
            del self._members[member.address]
            self.respawned += 1
            self._log(f"worker {member.address} gets no more jobs: {text}")

    def _became_ready(self, kind: JobKind, member: _Member, result: Any, text: str) -> list[Event]:
        if self._kinds.get(kind.number) is not kind:  # The kind was discarded meanwhile.
            return []
        is_first = kind.number not in self._prepared
        if isinstance(result, Prepared):
            member.ready.add(kind.number)
            if is_first:
                self._prepared[kind.number] = result
                self._log(f"measurements are processed {self.choice}")
            return [KindReady(result)] if is_first else []
        if isinstance(result, str) and is_first:  # No worker can make this pipeline.
            return [KindFailed(kind.number, result)]
        if result is None:
            self._leave(member, text)
        else:
            reported = result.text if isinstance(result, RemoteError) else result
            self._log(f"worker {member.address} cannot prepare: {reported}")
        return []

    def _finished(self, attempt: _Attempt, result: Any, text: str) -> Event:
        job, slot, member = attempt.job, attempt.slot, attempt.member
        self._attempts.remove(attempt)
        member.busy -= 1
        if isinstance(result, there.ClusterResult):
            job.slot, job.n_points, job.levels = slot, len(result.points), result.levels
            member.done += 1
            return FinishedJob(job, result.took_s)
        self._slots.release(slot)
        if isinstance(result, str):  # The measurement cannot be processed.
            return Lost(job, result, again=False)
        if isinstance(result, RemoteError):
            return Lost(job, result.text, again=True)
        self._leave(member, text)  # Another worker gets the second try.
        return Lost(job, text, again=True)


def _kept(made: there.ClusterResult, slot: Slot) -> there.ClusterResult:
    """Copy a result into a slot; runs in the thread of the client."""
    np.copyto(slot.view.image_as(made.image.shape, made.image.dtype), made.image)
    slot.view.points(made.points.nbytes)[:] = made.points.tobytes()
    return replace(made, image=made.image[:0])  # The image is large, and not needed any more.
