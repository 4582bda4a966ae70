"""Pool of local worker processes: start, jobs, deadlines, restart."""

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from ertis_numba.base.forks import usable_cores
from ertis_numba.network.log import EventLog
from ertis_numba.network.processing.options import ProcessingOptions
from ertis_numba.network.processing.parallelism import Choice, Load
from ertis_numba.network.processing.pipe_messages import (
    FromWorker,
    JobFailed,
    JobFinished,
    Predicted,
    Prepare,
    Prepared,
    ProcessJob,
    Ready,
    Release,
    StartWorker,
    Unusable,
)
from ertis_numba.network.processing.runner import (
    Event,
    FinishedJob,
    Job,
    JobKind,
    KindFailed,
    KindReady,
    Lost,
    Runner,
    bytes_of,
)
from ertis_numba.network.processing.shared_slots import Slot
from ertis_numba.network.processing.worker import SLOTS, Worker
from ertis_numba.network.status import WorkerStatus
from ertis_numba.network.trace import mark

__all__ = ["LocalWorkerPool", "new_runner"]

_LOADING_S: Final = 60.0
_TRIES: Final = 3  # Limit on workers that die while preparing for a kind that has never been ready.


class LocalWorkerPool:
    """`Runner` whose jobs run in processes of this machine; one that misses its deadline is killed."""

    # Each worker has its own pipe and two slots, so that its death at any time costs only its job.

    def __init__(self, options: ProcessingOptions, log: EventLog) -> None:
        self._options, self._log = options, log
        self._reported: set[tuple[str, str]] = set()  # Sensors and events, which are logged once for their settings.
        self._threads = options.threads or usable_cores()
        count = int(options.workers or (1 if options.device in {"cuda", "numpy"} else self._threads))
        self._chosen = Choice(count, self._threads)
        self._kinds: dict[int, JobKind] = {}
        self._prepared: dict[int, Prepared] = {}
        self._tries: dict[int, int] = {}
        self._workers = [Worker(number) for number in range(count)]
        self._started = 1  # The others wait until the first has compiled the common kernels and found a device.
        self.respawned = 0
        self._start(self._workers[0])

    @property
    def choice(self) -> str:
        """Distribution of measurements over the cores, with its reason."""
        return self._chosen.why

    def prepare(self, kind: JobKind) -> None:
        """Prepare for jobs of a kind; `KindReady` or `KindFailed` follows."""
        self._kinds[kind.number] = kind
        self._tries.pop(kind.number, None)
        for worker in self._workers:
            self._next_kind(worker)

    def forget(self, kind: JobKind) -> None:
        """Release a kind, because no more jobs of it will come."""
        self._kinds.pop(kind.number, None)
        self._prepared.pop(kind.number, None)
        self._tries.pop(kind.number, None)
        for worker in self._workers:
            if kind.number in worker.kinds and worker.child is not None:
                worker.kinds.discard(kind.number)
                worker.child.pipe.send(Release(kind=kind.number))

    def takes(self, kind: JobKind) -> bool:
        """Return True if a job of a kind can run now."""
        if self._idle(kind) is None:
            return False
        return sum(worker.job is not None for worker in self._workers) < self._chosen.mode.at_once

    def _idle(self, kind: JobKind) -> Worker | None:
        for worker in self._workers:
            if worker.state == "idle" and kind.number in worker.kinds and worker.free:
                return worker
        return None

    def submit(self, job: Job) -> None:
        """Run a job that `takes` accepts; `FinishedJob` or `Lost` follows."""
        worker = self._idle(job.kind)
        if worker is None or worker.child is None:
            raise AssertionError("a job was submitted that no worker can accept; call takes() first")
        if job.predict:  # The first measurement with these settings.
            self._reported = {each for each in self._reported if each[0] != job.data.sensor}
        worker.job, worker.mode = job, self._chosen.mode
        worker.slot = slot = worker.free.pop(0)
        slot.view.words(job.words.nbytes)[:] = bytes_of(job.words)
        worker.expect(self._options.deadline_s)
        worker.child.pipe.send(
            ProcessJob(
                job=job.number,
                kind=job.kind.number,
                slot=slot.number,
                words_bytes=job.words.nbytes,
                threads=worker.mode.threads,
                points=job.points,
                sensor=job.data.sensor,
                predict=job.predict,
                check_sound=job.check_sound,
            )
        )
        mark("submitted", job.data.sensor, job.data.sequence)

    def release(self, slot: Slot) -> None:
        """Release the slot of a finished job."""
        worker = self._workers[slot.number // SLOTS]
        if slot in worker.slots:
            worker.free.append(slot)

    def fds(self) -> Iterable[int]:
        """Return the descriptors to poll now."""
        return [fd for worker in self._workers for fd in worker.fds]

    def ready(self, fd: int) -> Sequence[Event]:
        """Return new events, after a descriptor became readable."""
        for worker in self._workers:
            if fd in worker.fds:
                return self._heard(worker)
        return []

    def tick(self, now_s: float, load: Load) -> Sequence[Event]:
        """Return new events; call it ten times a second with the load."""
        found: list[Event] = []
        for worker in self._workers[: self._started]:
            match worker.check(now_s):
                case "due":
                    self._start(worker)
                case "late":
                    self._log.warning("worker_killed", pid=worker.pid, text="it missed its deadline")
                case "ended":
                    found += self._heard(worker, has_ended=True)  # It may have sent messages before.
                case "running":
                    self._next_kind(worker)
        if self._chosen.update(now_s, load):
            self._log.info("choice", text=self._chosen.why)
        return found

    def status(self) -> list[WorkerStatus]:
        """Return the status of the workers."""
        return [
            WorkerStatus(pid=worker.pid, state=worker.state, done=worker.done)
            for worker in self._workers
            if worker.child is not None
        ]

    def close(self) -> None:
        """Close everything."""
        for worker in self._workers:
            if worker.child is not None:
                worker.child.kill()  # Left alone, it would end after its imports, without cleaning up either.
        for worker in self._workers:
            worker.close()
            for slot in worker.slots:
                slot.close()
            worker.slots, worker.free = [], []

    def _start(self, worker: Worker) -> None:
        options = self._options
        worker.start(_LOADING_S).pipe.send(
            StartWorker(
                device=options.device,
                dtype=options.dtype,
                threads=self._threads,
                at_once=len(self._workers),
                deadline_s=options.deadline_s,
                plan=options.plan,
            )
        )

    def _heard(self, worker: Worker, *, has_ended: bool = False) -> list[Event]:
        """Return the events in a worker's messages."""
        found: list[Event] = []
        if worker.child is None:
            return found
        for note in worker.receive():
            found += self._events_of(worker, note)
        if has_ended or (worker.child.pipe.closed and worker.child.ended):
            found += self._died(worker)
        elif worker.child.pipe.closed:  # `tick` cleans up.
            worker.ready = False
        else:
            self._next_kind(worker)
        return found

    def _events_of(self, worker: Worker, note: FromWorker) -> list[Event]:
        match note:
            case Ready(device=device, threads=threads):
                self._loaded(worker, device, threads)
            case Prepared():
                return self._became_ready(worker, note)
            case Unusable(kind=kind, text=text):
                worker.preparing = None
                worker.expect(None)
                if self._kinds.pop(kind, None) is not None:
                    return [KindFailed(kind, text)]
            case Predicted(sensor=sensor, event=event, warning=warning):
                if (sensor, event) not in self._reported:
                    self._reported.add((sensor, event))
                    self._log.warning(event, sensor=sensor, text=warning)
            case JobFinished() | JobFailed():
                return self._finished(worker, note)
        return []

    def _loaded(self, worker: Worker, device: str, threads: int) -> None:
        worker.ready = True
        worker.expect(None)
        if self._started == 1 and not self._kinds_known:
            if threads == 1 and self._options.workers is None and len(self._workers) > 1:
                # A GPU, for example, serves one measurement faster than several.
                self._log.info("choice", text=f"device {device} has one worker")
                del self._workers[1:]
                self._chosen = Choice(1, 1)
            elif threads < self._threads:
                self._chosen = Choice(len(self._workers), threads)

    @property
    def _kinds_known(self) -> bool:
        return bool(self._prepared)

    def _became_ready(self, worker: Worker, note: Prepared) -> list[Event]:
        kind = worker.preparing
        worker.preparing = None
        worker.expect(None)
        if worker.child is None or kind is None:
            return []
        if self._kinds.get(kind.number) is not kind:  # The kind was discarded meanwhile.
            worker.child.pipe.send(Release(kind=note.kind))
            return []
        worker.kinds.add(kind.number)
        worker.attach_memory(kind.words_bytes, self._image_bytes(note))
        self._started = len(self._workers)
        if kind.number in self._prepared:
            return []
        self._prepared[kind.number] = note
        self._chosen.seed(note.wide_s, note.many_s)
        return [KindReady(note)]

    def _image_bytes(self, note: Prepared) -> int:
        return int(np.prod(note.shape)) * np.dtype(self._options.dtype).itemsize

    def _finished(self, worker: Worker, note: JobFinished | JobFailed) -> list[Event]:
        job, slot = worker.job, worker.slot
        if job is None or slot is None or note.job != job.number:
            return []
        worker.job = worker.slot = None
        worker.expect(None)
        if isinstance(note, JobFailed):
            worker.free.append(slot)
            return [Lost(job, note.text, note.again)]
        worker.done += 1
        worker.succeeded()
        if worker.mode is not None:
            self._chosen.took(worker.mode, note.took_s)
        job.slot, job.n_points, job.levels = slot, note.n_points, note.levels
        return [FinishedJob(job, note.took_s)]

    def _next_kind(self, worker: Worker) -> None:
        """Let an idle worker prepare for a kind that it does not know."""
        if worker.child is None or worker.state != "idle":
            return
        if worker.kinds and any(other.preparing for other in self._workers):
            return  # One after the other, so that present sensors continue to be served.
        for number, kind in self._kinds.items():
            if number not in worker.kinds:
                worker.preparing = kind
                worker.expect(self._options.prepare_s)
                measure = not self._prepared
                worker.child.pipe.send(Prepare(kind=number, settings=kind.settings, measure=measure))
                return

    def _died(self, worker: Worker) -> list[Event]:
        """Clean up after a worker, and return the result for its job."""
        pid, found = worker.pid, list[Event]()
        worker.clear()
        worker.ready = False
        worker.kinds.clear()
        self.respawned += 1
        kind, job, slot = worker.preparing, worker.job, worker.slot
        worker.preparing = worker.job = worker.slot = None
        self._log.warning("worker_died", pid=pid, text="another takes its place")
        if kind is not None and kind.number in self._kinds and kind.number not in self._prepared:
            self._tries[kind.number] = self._tries.get(kind.number, 0) + 1
            if self._tries[kind.number] >= _TRIES:
                del self._kinds[kind.number]
                found.append(KindFailed(kind.number, "workers die while preparing for it"))
        if slot is not None:
            worker.free.append(slot)
        if job is not None:
            found.append(Lost(job, f"worker {pid} died while processing it, or was killed", again=True))
        return found


def new_runner(options: ProcessingOptions, log: EventLog) -> Runner:
    """Return the local pool of workers, or those of a cluster."""
    if not isinstance(options.workers, str):
        return LocalWorkerPool(options, log)
    from ertis_numba.network.processing.cluster import Cluster  # noqa: PLC0415  which needs another package

    return Cluster(options, lambda text: log.warning("cluster", text=text))
