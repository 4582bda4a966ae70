"""Supervision of a child process: deadlines, and restarts with growing delays."""

import time
from collections.abc import Mapping, Sequence
from typing import Any, Generic, Literal, TypeVar

from ertis_numba.processes.child import Child

__all__ = ["SupervisedProcess"]

Kind = TypeVar("Kind")


class SupervisedProcess(Generic[Kind]):
    """Child that is killed when it misses a deadline, and that is replaced when it has ended."""

    # No method blocks, except `close`: the owner polls `fds`, and calls `check` several times a second. `delays_s`
    # precede its replacement, by the number of earlier ends since the last `succeeded`.

    def __init__(
        self, module: str, kinds: Any, delays_s: Sequence[float], environment: Mapping[str, str] | None = None
    ) -> None:
        self._module, self._kinds, self._delays_s, self._environment = module, kinds, delays_s, environment
        self.child: Child[Kind] | None = None
        self.restarts = 0
        self._n_ended = 0
        self._start_s, self._deadline_s = 0.0, float("inf")

    @property
    def pid(self) -> int:
        """Identifier of the process; 0 while there is none."""
        return 0 if self.child is None else self.child.pid

    @property
    def fds(self) -> tuple[int, ...]:
        """Descriptors to poll now: that of its pipe, or none."""
        return () if self.child is None or self.child.pipe.closed else (self.child.pipe.fileno(),)

    def start(self, ready_s: float) -> Child[Kind]:
        """Start the process, and expect a message within a time."""
        self.child = Child(self._module, self._kinds, self._environment)
        self.expect(ready_s)
        return self.child

    def expect(self, time_s: float | None) -> None:
        """Set the deadline from now, after which the process is killed; None removes it."""
        self._deadline_s = float("inf") if time_s is None else time.monotonic() + time_s

    def succeeded(self) -> None:
        """Forget earlier ends, so that the next replacement starts without delay."""
        self._n_ended = 0

    def receive(self) -> list[Kind]:
        """Return received messages; a process with a closed or broken pipe is killed."""
        if self.child is None:
            return []
        notes = self.child.pipe.receive()
        if self.child.pipe.closed:  # `check` reports its end once it is gone and writes to no memory any more.
            self.child.kill()
        return notes

    def check(self, now_s: float) -> Literal["waiting", "due", "running", "late", "ended"]:
        """Return the state: ``late`` once if it missed its deadline and was killed, and ``due`` to be started."""
        if self.child is None:
            return "due" if now_s >= self._start_s else "waiting"
        self.child.pipe.flush()
        if now_s > self._deadline_s:
            self.expect(None)
            self.child.kill()
            return "late"
        return "ended" if self.child.ended else "running"

    def clear(self) -> None:
        """Clean up after an ended process, and set the time of its replacement."""
        self.close()
        self._start_s = time.monotonic() + self._delays_s[min(self._n_ended, len(self._delays_s) - 1)]
        self._n_ended += 1
        self.restarts += 1

    def close(self, timeout_s: float = 0.0) -> None:
        """Let the process end by itself, and kill it after a timeout."""
        if self.child is not None:
            self.child.close(timeout_s)
            self.child = None
        self.expect(None)
