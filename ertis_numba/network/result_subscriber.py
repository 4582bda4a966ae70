"""Base class of subscribers to results that are computed from received items."""

import time
from abc import abstractmethod
from typing import Generic, Protocol, TypeVar

from ertis_numba.network._subscription import SubscriberCounts
from ertis_numba.network.receiving_loop import ReceivingLoop

__all__ = ["ResultSubscriber"]

Item_co = TypeVar("Item_co", covariant=True)
Received = TypeVar("Received")


class _Source(Protocol[Item_co]):
    """Receiver of the items from which results are computed."""

    counts: SubscriberCounts

    @property
    def connected(self) -> bool: ...
    @property
    def n_skipped(self) -> int: ...
    def receive(self, timeout_s: float | None = None) -> Item_co | None: ...
    def close(self) -> None: ...


class ResultSubscriber(ReceivingLoop[Item_co], Generic[Received, Item_co]):
    """Application node that computes results from the items of a receiver."""

    def __init__(self, source: _Source[Received]) -> None:
        self._source = source
        self.counts: SubscriberCounts = source.counts

    @property
    def connected(self) -> bool:
        """True if a central node answers."""
        return self._source.connected

    @property
    def n_skipped(self) -> int:
        """Items that arrived but were not used, because the application was too slow."""
        return self._source.n_skipped

    def receive(self, timeout_s: float | None = None) -> Item_co | None:
        """Return the next result; None after ``timeout_s``, or once the subscriber is closed.

        Parameters
        ----------
        timeout_s : float, optional
            Time to wait; unlimited by default.

        Raises
        ------
        RefusedError
            The central node has refused this application from the start.
        DataError
            The mounting of a sensor is unknown, or its settings cannot be used.
        """
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while (
            received := self._source.receive(None if end_s is None else max(0.0, end_s - time.monotonic()))
        ) is not None:
            result = self._result(received)
            if result is not None:
                return result
        return None

    def close(self) -> None:
        """End the loop; waiting items are lost."""
        self._source.close()

    @abstractmethod
    def _result(self, received: Received) -> Item_co | None:
        """Return the result that an item completes; None if it completes none."""
