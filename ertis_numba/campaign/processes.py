"""Worker processes on this machine: start, tasks, restart after death."""

import json
import queue
import signal
import subprocess
import sys
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import IO, Any, Final

from ertis_numba.campaign.tasks import Task, TaskUpdate
from ertis_numba.errors import DeviceError

__all__ = ["ProcessPool"]

_MODULE: Final = "ertis_numba.campaign.worker_process"
_MAX_FAILED_STARTS: Final = 3  # Limit on successive processes that end before they are ready.
_MAX_STDERR_LINES: Final = 20  # Number of kept lines of stderr.


@dataclass(slots=True, eq=False)
class _WorkerProcess:
    """A process, and its current task."""

    process: "subprocess.Popen[str]"
    task: Task | None = None
    begun: bool = False
    ready: bool = False
    stated: deque[str] = field(default_factory=lambda: deque(maxlen=_MAX_STDERR_LINES))
    threads: list[threading.Thread] = field(default_factory=list)


class ProcessPool:
    """`WorkerPool` of new Python interpreters rather than forks, which OpenMP and HDF5 would not survive.

    Ctrl-C in a terminal does not reach them. They end with this process, even if it crashes.

    Parameters
    ----------
    size : int
        Number of processes.

    Raises
    ------
    DeviceError
        Processes end before they are ready; `wait` raises this error.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._reported: queue.SimpleQueue[tuple[_WorkerProcess, str | None]] = queue.SimpleQueue()
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
        return {worker.process.pid: _path(worker.task) for worker in self._workers}

    def limit(self, size: int) -> None:
        """Reduce the number of processes; a busy one ends after its task, if there are too many."""
        self._size = min(self._size, size)
        for worker in [worker for worker in self._workers if worker.task is None][self._size :]:
            self._end(worker)

    def submit(self, task: Task) -> None:
        """Run a task; never blocks."""
        worker = next((worker for worker in self._workers if worker.task is None), None) or self._start()
        worker.task, worker.begun = task, False
        stdin = worker.process.stdin
        if stdin is not None:
            with suppress(OSError):  # The process has ended, which `wait` detects.
                message = {"number": task.number, "action": task.action, "arguments": task.arguments}
                stdin.write(json.dumps(message) + "\n")
                stdin.flush()

    def wait(self, timeout_s: float) -> list[TaskUpdate]:
        """Return messages of workers, or an empty list after a timeout."""
        try:
            reported = [self._reported.get(timeout=timeout_s)]
        except queue.Empty:
            return []
        while not self._reported.empty():
            reported.append(self._reported.get())
        return [news for worker, line in reported if (news := self._handle_line(worker, line)) is not None]

    def close(self) -> None:
        """Kill all processes."""
        for worker in self._workers:
            worker.process.kill()  # Kill all of them before waiting for any.
        for worker in list(self._workers):
            self._end(worker)

    def _start(self) -> _WorkerProcess:
        # -P: Python must not import a file of the current folder in place of a standard module.
        process = subprocess.Popen(  # noqa: S603  this very package
            [sys.executable, "-P", "-m", _MODULE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="backslashreplace",
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),  # Windows has no sessions.
        )
        worker = _WorkerProcess(process)
        for work, stream in ((self._listen, process.stdout), (self._keep_stderr, process.stderr)):
            thread = threading.Thread(target=work, args=(worker, stream), daemon=True)
            thread.start()
            worker.threads.append(thread)
        self._workers.append(worker)
        return worker

    def _listen(self, worker: _WorkerProcess, stream: IO[str]) -> None:
        for line in stream:
            self._reported.put((worker, line))
        self._reported.put((worker, None))

    @staticmethod
    def _keep_stderr(worker: _WorkerProcess, stream: IO[str]) -> None:
        worker.stated.extend(line.strip() for line in stream if line.strip())

    def _handle_line(self, worker: _WorkerProcess, line: str | None) -> TaskUpdate | None:
        if line is None:
            return self._died(worker)
        try:
            reported: dict[str, Any] = json.loads(line)
        except ValueError:  # A killed process may have printed half a line.
            return None
        if "number" not in reported:
            worker.ready, self._n_failed_starts = True, 0
            return None
        worker.begun = True
        news = TaskUpdate(reported["number"], reported.get("done", 0), reported.get("result"))
        if news.result is not None:
            worker.task = None
            if len(self._workers) > self._size:
                self._end(worker)
        return news

    def _died(self, worker: _WorkerProcess) -> TaskUpdate | None:
        if worker not in self._workers:
            return None
        task = worker.task
        self._end(worker)
        how = _how_it_ended(worker)
        if not worker.ready:
            self._n_failed_starts += 1
        if self._n_failed_starts >= _MAX_FAILED_STARTS:
            raise DeviceError(f"worker processes end at once: the last one {how}; try 'ertis process' on one file")
        if task is not None and not worker.begun:
            self.submit(task)
            return None
        if task is None:
            return None
        text = f"{_path(task)}: its worker process {how}; if memory runs out, give fewer --workers"
        return TaskUpdate(task.number, result={"error": text, "by_chance": True})

    def _end(self, worker: _WorkerProcess) -> None:
        """Kill a process, and close its streams."""
        self._workers.remove(worker)
        worker.process.kill()
        worker.process.wait()
        for thread in worker.threads:
            thread.join()
        for stream in (worker.process.stdin, worker.process.stdout, worker.process.stderr):
            if stream is not None:
                with suppress(OSError):  # The process may not have read its input.
                    stream.close()


def _path(task: Task | None) -> str:
    return "" if task is None else str(task.arguments.get("path", ""))


def _how_it_ended(worker: _WorkerProcess) -> str:
    code = worker.process.returncode
    if code < 0:
        with suppress(ValueError):
            return f"was ended by {signal.Signals(-code).name}"
    stated = f", printing {worker.stated[-1]!r}" if worker.stated else ""
    return f"ended with {code}{stated}"
