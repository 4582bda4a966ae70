"""Sender in a thread of this process, for trials that do not kill it: it needs no interpreter of its own."""

import threading
import time
from types import TracebackType
from typing import Any, Final, Self

from ertis_bench.network.sender import Sender, SenderJob

from ertis_numba.base.errors import DataError

__all__ = ["SenderThread"]

_WAIT_S: Final = 60.0  # time limit for events that need no further action
Event = dict[str, Any]


class SenderThread:
    """Sender with the methods of a `ertis_bench.network.processes.JsonLinesProcess`; use it in a ``with`` statement.

    Parameters
    ----------
    job : SenderJob
    """

    def __init__(self, job: SenderJob) -> None:
        self._sender = Sender(job, emit=self._emit)
        self._events: list[Event] = []
        self._news = threading.Condition()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"sender {job.diary}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._sender.send()
        except BaseException as error:  # noqa: BLE001  raised in the thread that waits for the sender
            self._error = error
        with self._news:
            self._news.notify_all()

    def _emit(self, **event: object) -> None:
        with self._news:
            self._events.append(event)
            self._news.notify_all()

    def wait_for(self, name: str, *, timeout_s: float = _WAIT_S) -> Event:
        """Return the first event with a name.

        Raises
        ------
        DataError
            The event did not arrive in time.
        """
        end_s = time.monotonic() + timeout_s
        with self._news:
            while True:
                found = next((each for each in self._events if each["event"] == name), None)
                if found is not None:
                    return found
                left_s = end_s - time.monotonic()
                if self._error is not None or left_s <= 0:
                    raise DataError(f"event {name!r} of a sender did not arrive") from self._error
                self._news.wait(left_s)

    def signal(self, _: int) -> None:
        """End the measurements, as any signal does."""
        self._sender.stopped = True

    def wait(self, *, timeout_s: float = _WAIT_S) -> int:
        """Wait until the sender has ended, and return 0, as the exit code of a process.

        Raises
        ------
        DataError
            The sender failed, or does not end in time.
        """
        self._thread.join(timeout_s)
        if self._error is not None or self._thread.is_alive():
            raise DataError("a sender failed or does not end") from self._error
        return 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._sender.stopped = True
        self._thread.join(self._sender.job.patience_s if error is None else 0.0)
