"""Worker process that runs the tasks of a campaign; `ProcessPool` starts it."""

import functools
import json
import time
from pathlib import Path
from typing import Final

from ertis_numba.campaign.folder import clear_parts
from ertis_numba.campaign.task_actions import run_task
from ertis_numba.campaign.tasks import RunTask, TaskReport, WorkerReady
from ertis_numba.processes import connect

__all__: list[str] = []

_REPORT_INTERVAL_S: Final = 0.1


class _TaskRunner:
    def __init__(self) -> None:
        self._target: Path | None = None
        self._reported_s = 0.0
        self._pipe = connect(RunTask, on_parent_end=self._clear)

    def run(self) -> None:
        self._pipe.send(WorkerReady())
        for task in self._pipe.messages():
            self._run_task(task)

    def _run_task(self, task: RunTask) -> None:
        self._pipe.send(TaskReport(task.number))  # From now on, the task counts as the cause if this process ends.
        arguments = json.loads(task.arguments)
        if task.action == "make":
            self._target = Path(arguments["target"])
        try:
            result = run_task(task.action, arguments, functools.partial(self._advance, task.number))
        except Exception as error:  # noqa: BLE001  an error in one recording must not affect others
            text = f"{arguments.get('path', '')}: {type(error).__name__}: {' '.join(str(error).split())}"
            result = {"error": text, "by_chance": True}
        self._target = None
        self._pipe.send(TaskReport(task.number, result=json.dumps(result)))

    def _advance(self, number: int, done: int) -> None:
        if time.monotonic() > self._reported_s + _REPORT_INTERVAL_S:
            self._reported_s = time.monotonic()
            self._pipe.send(TaskReport(number, done))

    def _clear(self) -> None:
        """Remove the half-written file, which no other process can use."""
        if (target := self._target) is not None:
            clear_parts(target.parent, {target.name})


if __name__ == "__main__":
    _TaskRunner().run()
