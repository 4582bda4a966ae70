"""Acknowledgements to sensor nodes."""

import time
from collections.abc import Callable
from typing import Final, Literal

from ertis_numba.network.central_node._streams import Stream
from ertis_numba.network.messages import Ack, Message
from ertis_numba.network.status import Latencies

__all__ = ["Acks"]

_DROPS: Final = 32  # Limit on the drops in one ack.


class Acks:
    """Pending acks, one per session for any number of measurements.

    Parameters
    ----------
    send : callable
        Called with a peer and a message to it.
    status : {"stored", "accepted"}
        Place of acknowledged measurements: on disk, or in memory.

    Attributes
    ----------
    latencies : Latencies
        Time from the arrival of a measurement to its ack.
    """

    def __init__(self, send: Callable[[bytes, Message], None], status: Literal["stored", "accepted"]) -> None:
        self._send: Final = send
        self._status: Final = status
        self._due: dict[tuple[str, int], Stream] = {}  # By sensor and session.
        self._arrived_s: list[float] = []
        self.latencies = Latencies()

    def owe(self, stream: Stream) -> None:
        """Schedule an ack of a session."""
        self._due[stream.run] = stream

    def acked_through(self, arrived_s: float) -> None:
        """Count a measurement that the next ack acknowledges."""
        self._arrived_s.append(arrived_s)

    def forget(self, stream: Stream) -> None:
        """Send no more acks for a session."""
        self._due.pop(stream.run, None)

    def send(self) -> None:
        """Send pending acks."""
        for (sensor, session_id), stream in self._due.items():
            if not stream.owner:
                continue
            dropped = tuple(stream.dropped.popleft() for _ in range(min(_DROPS, len(stream.dropped))))
            ack = Ack(
                sensor=sensor,
                session_id=session_id,
                acked_through=stream.acked_through,
                status=self._status,
                dropped=dropped,
            )
            self._send(stream.owner, ack)
        self._due.clear()
        if self._arrived_s:
            now_s = time.monotonic()
            for arrived_s in self._arrived_s:
                self.latencies.add(1e3 * (now_s - arrived_s))
            self._arrived_s.clear()
