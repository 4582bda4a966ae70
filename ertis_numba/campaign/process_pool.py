"""Worker processes on this machine: start, tasks, restart after death."""

import json
from dataclasses import dataclass
from typing import Final

from ertis_numba.base.errors import DeviceError
from ertis_numba.campaign.tasks import FromWorkerProcess, RunTask, Task, TaskReport, TaskUpdate
from ertis_numba.processes import Child, wait_for

__all__ = ["ProcessPool"]

_MODULE: Final = "ertis_numba.campaign.worker_process"
_LAST_WORDS_S: Final = 2.0  # Timeout of a process that has closed its pipe, until it ends with its own exit code.
_MAX_FAILED_STARTS: Final = 3  # Limit on successive processes that end before they are ready.


@dataclass(slots=True, eq=False)
class _WorkerProcess:
    """A process, and its current task."""

    child: Child[FromWorkerProcess]
    task: Task | None = None
    begun: bool = False
    ready: bool = False


class ProcessPool:
    """`WorkerPool` of processes on this machine; one that dies costs its recording, and is replaced."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._workers: list[_WorkerProcess] = []
        self._n_failed_starts = 0
        try:
            for _ in range(size):
                self._start()
        except BaseException:
            self.close()
            raise

    @property
    def size(self) -> int:
        """Number of tasks in progress at once."""
        return self._size

    @property
    def free(self) -> int:
        """Number of tasks that can be given now."""
        return max(0, self._size - sum(worker.task is not None for worker in self._workers))

    @property
    def current_paths(self) -> dict[int, str]:
        """Recording in progress of each process, by process identifier; empty for an idle one."""
        return {worker.child.pid: _path(worker.task) for worker in self._workers}

    def limit(self, size: int) -> None:
        """Reduce the number of processes; a busy one ends after its task, if there are too many."""
        self._size = min(self._size, size)
        for worker in [worker for worker in self._workers if worker.task is None][self._size :]:
            self._end(worker)

    def submit(self, task: Task) -> None:
        """Run a task; never blocks."""
        worker = next((worker for worker in self._workers if worker.task is None), None) or self._start()
        worker.task, worker.begun = task, False
        worker.child.pipe.send(RunTask(task.number, task.action, json.dumps(task.arguments)))

    def wait(self, timeout_s: float) -> list[TaskUpdate]:
        """Return messages of workers, or an empty list after a timeout."""
        ready = wait_for((worker.child.pipe for worker in self._workers), timeout_s)
        updates: list[TaskUpdate] = []
        for worker in [worker for worker in self._workers if worker.child.pipe in ready]:
            for note in worker.child.pipe.receive():
                updates += self._handle(worker, note)
            if worker.child.pipe.closed and worker in self._workers:
                updates += self._died(worker)
        return updates

    def close(self) -> None:
        """Kill all processes."""
        for worker in self._workers:
            worker.child.kill()  # Kill all of them before waiting for any.
        for worker in list(self._workers):
            self._end(worker)

    def _start(self) -> _WorkerProcess:
        worker = _WorkerProcess(Child(_MODULE, FromWorkerProcess, keep_stderr=True))
        self._workers.append(worker)
        return worker

    def _handle(self, worker: _WorkerProcess, note: FromWorkerProcess) -> list[TaskUpdate]:
        if not isinstance(note, TaskReport):
            worker.ready, self._n_failed_starts = True, 0
            return []
        worker.begun = True
        update = TaskUpdate(note.number, note.done, json.loads(note.result) if note.result else None)
        if update.result is not None:
            worker.task = None
            if len(self._workers) > self._size:
                self._end(worker)
        return [update]

    def _died(self, worker: _WorkerProcess) -> list[TaskUpdate]:
        task = worker.task
        how = self._end(worker, _LAST_WORDS_S)
        if not worker.ready:
            self._n_failed_starts += 1
        if self._n_failed_starts >= _MAX_FAILED_STARTS:
            raise DeviceError(f"worker processes end at once: the last one {how}; try 'ertis process' on one file")
        if task is None:
            return []
        if not worker.begun:
            self.submit(task)
            return []
        text = f"{_path(task)}: its worker process {how}; if memory runs out, use fewer processes (workers)"
        return [TaskUpdate(task.number, result={"error": text, "by_chance": True})]

    def _end(self, worker: _WorkerProcess, timeout_s: float = 0.0) -> str:
        """Kill a process after a timeout, and return how it ended."""
        self._workers.remove(worker)
        worker.child.close(timeout_s)
        return worker.child.wait()


def _path(task: Task | None) -> str:
    return "" if task is None else str(task.arguments.get("path", ""))
