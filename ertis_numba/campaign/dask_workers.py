"""Workers of an existing dask cluster, for several machines."""

import queue
import secrets
import time
from concurrent.futures import CancelledError
from contextlib import ExitStack
from typing import Any, Final

from ertis_numba.base.errors import NetworkError
from ertis_numba.campaign.task_actions import run_task
from ertis_numba.campaign.tasks import Task, TaskUpdate
from ertis_numba.processes import cluster
from ertis_numba.storage.schema import software_versions

__all__ = ["DaskWorkerPool", "run_on_dask_worker"]

_CONNECT_S: Final = 10.0
_POLL_INTERVAL_S: Final = 1.0
_REPORT_INTERVAL_S: Final = 0.5


class DaskWorkerPool:
    """`WorkerPool` of the workers of a dask scheduler, with at most one recording in progress per worker.

    A worker of one thread receives its next task early, so that it does not wait for the scheduler and this client.
    """

    # Workers need the same versions and paths of files. Anyone who reaches a scheduler can run code on its workers.

    def __init__(self, address: str) -> None:
        self._address = address
        self._topic = f"ertis-{secrets.token_hex(4)}"
        self._reported: queue.SimpleQueue[TaskUpdate] = queue.SimpleQueue()
        self._futures: dict[int, cluster.Future] = {}
        with ExitStack() as stack:
            self._client = cluster.connect(address, timeout_s=_CONNECT_S)
            # Dask would print tracebacks for a lost scheduler, which `wait` reports in one line.
            stack.enter_context(cluster.silence_loggers())
            stack.callback(self._client.close, timeout=2)
            cluster.require_workers(self._client, address, timeout_s=_CONNECT_S)
            self._count()
            self._client.subscribe_topic(self._topic, self._advance)
            self._stack = stack.pop_all()
        self._looked_s = time.monotonic()

    @property
    def size(self) -> int:
        """Number of tasks in progress at once."""
        return self._size

    @property
    def free(self) -> int:
        """Number of tasks that can be given now."""
        return max(0, self._size + self._n_early - len(self._futures))  # Workers may have been lost.

    def limit(self, size: int) -> None:
        """Do nothing: each worker of a cluster has its own device."""

    def submit(self, task: Task) -> None:
        """Run a task; never blocks."""
        future = self._client.submit(
            run_on_dask_worker,
            task.action,
            {**task.arguments, "versions": software_versions()},
            self._topic,
            task.number,
            key=f"{self._topic}-{task.number}",
            pure=False,
        )
        self._futures[task.number] = future
        future.add_done_callback(lambda done, number=task.number: self._reported.put(_news(number, done)))

    def wait(self, timeout_s: float) -> list[TaskUpdate]:
        """Return messages of workers, or an empty list after a timeout."""
        if self._client.status != "running":
            raise NetworkError(
                f"the dask scheduler at {self._address} is gone; finished output stays. Use another scheduler "
                "to continue"
            )
        self._update_size()
        try:
            news = [self._reported.get(timeout=timeout_s)]
        except queue.Empty:
            return []
        while not self._reported.empty():
            news.append(self._reported.get())
        for each in news:
            if each.result is not None:
                self._futures.pop(each.number, None)
        return news

    def close(self) -> None:
        """Cancel all tasks: dask cannot end a thread, but a cancelled task stops at its next progress report."""
        with self._stack:
            if self._client.status == "running":
                self._client.cancel(list(self._futures.values()), force=True)

    def _count(self) -> None:
        """Count the workers; those of several threads would begin an early task at once, beside another one."""
        threads: list[int] = [*self._client.nthreads().values()]
        self._size, self._n_early = max(1, len(threads)), threads.count(1)

    def _advance(self, event: tuple[Any, dict[str, Any]]) -> None:
        """Process a message of a task; runs in the thread of the client."""
        _, reported = event
        self._reported.put(TaskUpdate(reported["number"], reported["done"]))

    def _update_size(self) -> None:
        """Count the workers again from time to time."""
        if time.monotonic() < self._looked_s + _POLL_INTERVAL_S:
            return
        self._looked_s = time.monotonic()
        try:
            self._count()
        except (OSError, TimeoutError):  # The scheduler may return. Otherwise the status of the client changes.
            return


def _news(number: int, future: cluster.Future) -> TaskUpdate:
    """Return the result of a task; runs in the thread of the client."""
    try:
        return TaskUpdate(number, result=future.result(timeout=_CONNECT_S))
    except CancelledError:
        return TaskUpdate(
            number, result={"error": "the cluster has cancelled the task; process again", "by_chance": True}
        )
    except Exception as error:  # noqa: BLE001  the campaign reports any error
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        return TaskUpdate(number, result={"error": text, "by_chance": True})


class _TaskCancelledError(Exception):
    """The task was cancelled."""


def run_on_dask_worker(action: str, arguments: dict[str, Any], topic: str, number: int) -> dict[str, Any]:
    """Run a task on a worker of the cluster, as `work.run_task` does; ``topic`` receives its progress."""
    here = cluster.current_worker()
    for name, wanted in arguments["versions"].items():
        came = software_versions()[name]
        if came != wanted:
            return {
                "error": f"worker {here.address} has {name} {came}, not {wanted}; install the same version everywhere"
            }
    reported_s = 0.0

    def notify(done: int) -> None:
        nonlocal reported_s
        task = here.state.tasks.get(f"{topic}-{number}")
        if task is None or task.state == "cancelled":
            raise _TaskCancelledError
        if time.monotonic() > reported_s + _REPORT_INTERVAL_S:
            reported_s = time.monotonic()
            here.log_event(topic, {"number": number, "done": done})

    return run_task(action, {**arguments, "at_most": here.state.nthreads}, notify)
