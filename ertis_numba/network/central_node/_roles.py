"""Interfaces that the intake uses, and its refusals."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.network.central_node._received_items import ReceivedItem, SensorSession
from ertis_numba.network.fields import as_line
from ertis_numba.network.messages import Data, Hello, Message, Refused
from ertis_numba.settings import Settings

__all__ = ["MeasurementConsumer", "Store", "Unwanted"]


class Unwanted(Exception):  # noqa: N818  it is an answer
    """Refused message.

    Parameters
    ----------
    code : str
        As in `ertis_numba.network.messages.Refused`.
    reason : str
        Reason for the sender, in one line.
    kind : str
        Category in the counts.
    """

    def __init__(self, code: Any, reason: str, kind: str) -> None:
        super().__init__(reason)
        self.code, self.kind = code, kind

    def answer(self, about: Message) -> Refused:
        """Return the answer to the sender."""
        sensor, session_id = getattr(about, "sensor", ""), getattr(about, "session_id", 0)
        return Refused(code=self.code, reason=as_line(str(self)), sensor=sensor, session_id=session_id)


class Store(Protocol):
    """Interface to durable storage."""

    def acked_through(self, run: SensorSession) -> int:
        """Return the number up to which a session is acknowledged."""

    def offer(self, item: ReceivedItem) -> None:
        """Queue an item to be stored; never blocks."""


class MeasurementConsumer(Protocol):
    """Interface to consumers of new measurements."""

    def register(self, hello: Hello, settings: Settings) -> None:
        """Register a sensor."""

    def offer(self, data: Data, words: NDArray[np.unsignedinteger[Any]], arrived_ns: int) -> None:
        """Accept a measurement, whose data must not change any more; never blocks."""
