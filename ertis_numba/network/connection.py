"""Connection of a client to a central node or a publisher."""

import time
from typing import Final

import zmq

from ertis_numba.network import sockets
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.messages import PING_INTERVAL_S, Ping, encode
from ertis_numba.network.wakeup_socket import WakeupSocket

__all__ = ["Connection"]

_READ_OR_WRITE: Final = zmq.POLLIN | zmq.POLLOUT


class Connection:
    """Socket of a client with its monitor: sends, receives, pings, and reports refusals; for one thread."""

    # A client that has been refused, or hears nothing, makes a new connection. Without `keys`: loopback only.

    def __init__(
        self,
        context: "zmq.Context[zmq.Socket[bytes]]",
        address: str,
        *,
        keys: ClientKeys | None,
        max_bytes: int = sockets.MAX_BYTES,
    ) -> None:
        self._socket = sockets.client(context, address, keys=keys, max_bytes=max_bytes)
        self._monitor = sockets.Monitor(self._socket)
        self._poller = zmq.Poller()
        self._poller.register(self._monitor.socket, zmq.POLLIN)
        self._ping_s: float | None = None
        self.opened_s = time.monotonic()
        self.sent_s: float | None = None
        self.heard_s: float | None = None
        self.is_blocked = False

    @property
    def has_ended(self) -> bool:
        """Return True if ZeroMQ has given up; see `refusals` for the reason."""
        return self._monitor.final

    @property
    def n_disconnections(self) -> int:
        """Number of connections that had ended by the last call of `refusals`."""
        return self._monitor.n_disconnections

    def wait(self, timeout_s: float, wakeup_socket: WakeupSocket | None = None) -> None:
        """Wait until there is a message, a refusal, room for a message, or a wake-up."""
        self._poller.register(self._socket, _READ_OR_WRITE if self.is_blocked else zmq.POLLIN)
        if wakeup_socket is not None:
            self._poller.register(wakeup_socket, zmq.POLLIN)
        ready = dict(self._poller.poll(round(1000 * timeout_s)))
        if self.is_blocked and ready.get(self._socket, 0) & zmq.POLLOUT:
            self.is_blocked = False

    def refusals(self) -> list[str]:
        """Return the reasons of new refusals as lines, each once."""
        return self._monitor.read()

    def receive(self) -> list[memoryview] | None:
        """Return the frames of the next message, or None if there is none."""
        if not sockets.is_readable(self._socket):
            return None
        return [frame.buffer for frame in self._socket.recv_multipart(zmq.NOBLOCK, copy=False)]

    def send(self, *frames: bytes | memoryview) -> bool:
        """Send a message, and return True if there was room for it."""
        try:
            self._socket.send_multipart(frames, zmq.NOBLOCK, copy=False)
        except zmq.Again:  # Not connected, or the peer is slow.
            self.is_blocked = True
            return False
        self.sent_s = self.sent_s or time.monotonic()
        return True

    def ping_is_due(self, now_s: float) -> bool:
        """Return True if the last ping was sent an interval ago, or never."""
        return self._ping_s is None or now_s - self._ping_s >= PING_INTERVAL_S

    def ping(self, now_s: float) -> None:
        """Send a ping if it is due and there is room for it."""
        if self.ping_is_due(now_s) and self.send(encode(Ping())):
            self._ping_s = now_s

    def close(self, linger_s: float = 0.0) -> None:
        """Close the socket, after it has sent its messages or the time is up."""
        self._monitor.close()
        self._socket.close(linger=round(1000 * linger_s))
