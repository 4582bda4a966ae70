"""Client that requests the status of a central node."""

import time
from types import TracebackType
from typing import Final, Self

import zmq

from ertis_numba.errors import NetworkError, RefusedError
from ertis_numba.network import addresses, messages
from ertis_numba.network.connection import Connection
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.messages import AskStatus, Refused, Report
from ertis_numba.network.status import Status

__all__ = ["Asking"]

_REPORT_BYTES: Final = 4_000_000
_AGAIN_S: Final = 0.5
_TURN_S: Final = 0.1


class Asking:
    """Client for the status of a central node; use it in a ``with`` statement.

    Parameters
    ----------
    address : str
        Address for sensor nodes or for applications.
    keys : ClientKeys, optional
        Keys of an application or an admin.

    Raises
    ------
    ArgumentError
        The address cannot be used, or requires keys.
    """

    def __init__(self, address: str, *, keys: ClientKeys | None = None) -> None:
        self._address, self._keys = addresses.endpoint(address), keys
        addresses.require_keys(self._address, keys=keys)
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._connection: Connection | None = None

    def __enter__(self) -> Self:
        self._context = zmq.Context()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._hang_up()
        if self._context is not None:
            self._context.destroy(linger=0)
        self._context = None

    def ask(self, patience_s: float = 3.0) -> Status:
        """Return the status.

        Parameters
        ----------
        patience_s : float
            Timeout.

        Raises
        ------
        NetworkError
            There was no answer within the timeout.
        RefusedError
            The central node refuses this node, or its request.
        DataError
            The answer is not of this protocol.
        """
        end_s, asked_s, why = time.monotonic() + patience_s, 0.0, ""
        while time.monotonic() < end_s:
            connection = self._opened()
            if time.monotonic() - asked_s > _AGAIN_S and connection.send(messages.encode(AskStatus())):
                asked_s = time.monotonic()
            connection.wait(min(_TURN_S, patience_s))
            while frames := connection.receive():
                answer = _read(frames)
                if answer is not None:
                    return answer
            why = next(iter(connection.refusals()), why)
            if connection.has_ended:
                break
        self._hang_up()
        if why:
            raise RefusedError(f"{self._address}: {why}")
        raise NetworkError(
            f"no answer from {self._address} within {patience_s:g} s; start a central node there with 'ertis "
            "record' or 'ertis serve', or correct the address"
        )

    def _opened(self) -> Connection:
        if self._context is None:
            raise NetworkError("this client is not open; use it in a with statement")
        if self._connection is None:
            self._connection = Connection(self._context, self._address, keys=self._keys, max_bytes=_REPORT_BYTES)
        return self._connection

    def _hang_up(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection = None


def _read(frames: list[memoryview]) -> Status | None:
    """Return a status; None for other messages."""
    message = messages.decode(frames[0])
    if isinstance(message, Refused):
        raise RefusedError(message.reason)
    if not isinstance(message, Report):
        return None
    return Status.decode(b"".join(frames[1:]))
