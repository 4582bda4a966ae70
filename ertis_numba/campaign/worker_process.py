"""Worker process that runs tasks from JSON lines: ``python -m ertis_numba.campaign.worker_process``.

The process ends as soon as its input is closed.
"""

import functools
import json
import os
import queue
import signal
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final

from ertis_numba.campaign.folder import clear_parts
from ertis_numba.campaign.work import run_task

__all__ = ["main"]

_REPORT_INTERVAL_S: Final = 0.1


class _Process:
    def __init__(self, out: IO[str]) -> None:
        self._out = out
        self._tasks: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._target: Path | None = None
        self._reported_s = 0.0

    def run(self) -> None:
        threading.Thread(target=self._listen, daemon=True).start()
        self._out.write("{}\n")
        self._out.flush()
        while True:
            task = self._tasks.get()
            number, arguments = task["number"], task["arguments"]
            self._emit_event(number)  # From now on, the task counts as the cause if this process ends.
            if task["action"] == "make":
                self._target = Path(arguments["target"])
            try:
                result = run_task(task["action"], arguments, functools.partial(self._advance, number))
            except Exception as error:  # noqa: BLE001  an error in one recording must not affect others
                text = f"{arguments.get('path', '')}: {type(error).__name__}: {' '.join(str(error).split())}"
                result = {"error": text, "by_chance": True}
            self._target = None
            self._emit_event(number, result=result)

    def _advance(self, number: int, done: int) -> None:
        if time.monotonic() > self._reported_s + _REPORT_INTERVAL_S:
            self._reported_s = time.monotonic()
            self._emit_event(number, done=done)

    def _emit_event(self, number: int, **fields: Any) -> None:
        self._out.write(json.dumps({"number": number, **fields}) + "\n")
        self._out.flush()

    def _listen(self) -> None:
        for line in sys.stdin:
            self._tasks.put(json.loads(line))
        # The parent process has ended. Remove the half-written file, which no other process can use.
        if (target := self._target) is not None:
            with suppress(OSError):
                clear_parts(target.parent, {target.name})
        os._exit(0)


def main() -> None:
    """Run tasks from stdin, and print their results on stdout."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent process decides when to end.
    out = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # Other output must not mix with the messages.
    _Process(out).run()


if __name__ == "__main__":
    main()
