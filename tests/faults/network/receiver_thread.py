"""Receiver in a thread of this process, for trials that do not kill it: it needs no interpreter of its own."""

import threading
from types import TracebackType
from typing import Final, Self

from ertis_bench.network.processes import until
from ertis_bench.network.receiver import ReceiverJob, receive, subscriber_of

from ertis_numba.base.errors import DataError

__all__ = ["ReceiverThread"]

_WAIT_S: Final = 60.0  # time limit of the end


class ReceiverThread:
    """Receiver that runs until the end of a ``with`` statement, or until it is stopped.

    Once it is created, it is subscribed: it misses no later image.

    Parameters
    ----------
    job : ReceiverJob

    Raises
    ------
    DataError
        No central node answers.
    """

    def __init__(self, job: ReceiverJob) -> None:
        self._job = job
        self._subscriber = subscriber_of(job, on_note=lambda _: None)
        if not until(lambda: self._subscriber.connected):
            self._subscriber.close()
            raise DataError(f"no central node answers at {job.address}")
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"receiver {job.diary}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            receive(self._job, self._subscriber)
        except BaseException as error:  # noqa: BLE001  raised in the thread that stops the receiver
            self._error = error

    def stop(self) -> None:
        """End the subscription, and wait until all received products are in the diary.

        Raises
        ------
        DataError
            The receiver failed, or does not end in time.
        """
        self._subscriber.close()
        self._thread.join(_WAIT_S)
        if self._error is not None or self._thread.is_alive():
            raise DataError("a receiver failed or does not end") from self._error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._subscriber.close()
        self._thread.join(_WAIT_S if error is None else 0.0)
