"""Who the intake has to do with, and how it says no."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.network.central_node._received_items import ReceivedItem, SensorSession
from ertis_numba.network.fields import as_line
from ertis_numba.network.messages import Data, Hello, Message, Refused
from ertis_numba.settings import Settings

__all__ = ["Store", "Unwanted", "Viewer"]


class Unwanted(Exception):  # noqa: N818  it is an answer
    """A message that is not taken.

    Parameters
    ----------
    code : str
        As in `ertis_numba.network.messages.Refused`.
    reason : str
        The line to be told.
    kind : str
        By which it is counted.
    """

    def __init__(self, code: Any, reason: str, kind: str) -> None:
        super().__init__(reason)
        self.code, self.kind = code, kind

    def answer(self, about: Message) -> Refused:
        """Return what to tell the sender."""
        sensor, session_id = getattr(about, "sensor", ""), getattr(about, "session_id", 0)
        return Refused(code=self.code, reason=as_line(str(self)), sensor=sensor, session_id=session_id)


class Store(Protocol):
    """What makes measurements durable."""

    def acked_through(self, run: SensorSession) -> int:
        """Return how far a run is settled."""

    def offer(self, item: ReceivedItem) -> None:
        """Have something stored; returns at once."""


class Viewer(Protocol):
    """What is shown measurements that are new."""

    def register(self, hello: Hello, settings: Settings) -> None:
        """Take note of a sensor."""

    def offer(self, data: Data, words: NDArray[np.unsignedinteger[Any]], arrived_ns: int) -> None:
        """Take a measurement, whose words nobody changes any more; returns at once."""
