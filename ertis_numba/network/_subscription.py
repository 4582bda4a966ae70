"""Connection of an application to a publisher: requests, products and reconnection."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Final

import zmq

from ertis_numba.errors import ErtisError, FormatVersionError, RefusedError
from ertis_numba.network import sockets
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.messages import (
    PING_INTERVAL_S,
    SILENCE_LIMIT_S,
    Bye,
    Description,
    Group,
    Image,
    Message,
    Ping,
    Points,
    Pong,
    Product,
    Raw,
    Refused,
    Report,
    Subscribe,
    decode,
    encode,
)
from ertis_numba.network.products import Arrival, Header, ProductReader
from ertis_numba.network.wakeup_socket import WakeupSocket

__all__ = ["SubscriberCounts", "Subscription"]

_EXPECTED: Final = (Description, Image, Points, Raw, Group, Report, Pong, Refused)
_UNMADE_S: Final = 5.0  # ZeroMQ gives up after a refusal, whose event may precede the monitor.
_AGAIN_S: Final = 0.5
_MAX_AGAIN_S: Final = 5.0
_REFUSALS: Final = 3  # Limit on refusals before the first answer, after which retrying is useless.
_AT_ONCE: Final = 64


@dataclass(slots=True)
class SubscriberCounts:
    """Counts of an application's products.

    Attributes
    ----------
    received : int
        Products that the application has taken.
    dropped : int
        Products that the publisher dropped because the application was slow.
    missed : int
        Numbers that never arrived; equal to ``dropped`` except for those still on their way.
    reconnects : int
    damaged : int
        Invalid messages; each ends a connection.
    """

    received: int = 0
    dropped: int = 0
    missed: int = 0
    reconnects: int = 0
    damaged: int = 0


@dataclass(slots=True)
class _Connection:
    """Counts since a connection was made."""

    number: int
    begun_s: float
    first_asked_s: float | None = None
    asked_s: float | None = None
    heard_s: float | None = None
    taken: int = 0
    received: int = 0
    next_number: int = 0
    reader: ProductReader = field(default_factory=ProductReader)


class Subscription:
    """Client that requests products and reads them in one thread; another thread may call only `taken`.

    Parameters
    ----------
    address : str
    sensors : tuple of str or None
    products : tuple of str
    keys : ClientKeys or None
    on_note : callable
    credit : int
    counts : SubscriberCounts
    deliver : callable
        Gets each `Arrival`.
    """

    def __init__(
        self,
        address: str,
        *,
        sensors: tuple[str, ...] | None,
        products: tuple[Product, ...],
        keys: ClientKeys | None,
        on_note: Callable[[str], None],
        credit: int,
        counts: SubscriberCounts,
        deliver: Callable[[Arrival], None],
    ) -> None:
        self._address, self._keys, self._credit = address, keys, credit
        self._sensors, self._products = sensors, products
        self._note, self._counts, self._deliver = on_note, counts, deliver
        self._context: zmq.Context[zmq.Socket[bytes]]
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: sockets.Monitor | None = None
        self._connection = _Connection(0, 0.0)
        self._taken: deque[int] = deque()
        self._ask = True
        self._wait_until_s = 0.0
        self._refusals: list[str] = []
        self._was_connected = False
        self._reported = ""
        self._dropped_before = self._missed_before = 0

    @property
    def connected(self) -> bool:
        """Return True if the publisher has answered on this connection."""
        return self._connection.heard_s is not None

    def taken(self, arrival: Arrival) -> None:
        """Register that the application has taken a product, so that another may be sent."""
        self._taken.append(arrival.connection)

    @contextmanager
    def within(self, context: "zmq.Context[zmq.Socket[bytes]]") -> Iterator[None]:
        """Use a context until the block ends."""
        self._context = context
        try:
            yield
            self._send(Bye())
        finally:
            self._close()

    def turn(self, woken: WakeupSocket, now_s: float) -> None:
        """Do pending work, or wait up to a tenth of a second.

        Raises
        ------
        RefusedError
            The publisher refuses this application, and has never accepted it.
        """
        if self._socket is None:
            if now_s < self._wait_until_s:
                _wait(woken, min(0.1, self._wait_until_s - now_s))
                return
            self._open(now_s)
        self._subscribe(now_s)
        ready = self._poll(woken)
        if self._monitor is not None and self._monitor.socket in ready:
            for text in self._monitor.read()[-1:]:
                self._refuse(text, time.monotonic())
                return
        if self._socket in ready:
            self._read_all()
        connection, now_s = self._connection, time.monotonic()
        since_s = connection.heard_s if connection.heard_s is not None else connection.first_asked_s
        if since_s is not None and now_s - since_s > SILENCE_LIMIT_S:
            self._again(f"the publisher has been silent for {SILENCE_LIMIT_S:g} s; connecting again", now_s)
        elif since_s is None and self._socket is not None and now_s - connection.begun_s > _UNMADE_S:
            self._again("", now_s)

    def _poll(self, woken: WakeupSocket) -> list[object]:
        poller = zmq.Poller()
        poller.register(woken, zmq.POLLIN)
        for socket in (self._socket, self._monitor.socket if self._monitor else None):
            if socket is not None:
                poller.register(socket, zmq.POLLIN)
        return [socket for socket, _ in poller.poll(100)]

    def _open(self, now_s: float) -> None:
        self._socket = sockets.client(self._context, self._address, keys=self._keys)
        self._monitor = sockets.Monitor(self._socket)
        self._connection = _Connection(self._connection.number + 1, now_s)
        self._ask = True

    def _close(self, now_s: float = 0.0) -> None:
        if self._monitor is not None:
            self._monitor.close()
        if self._socket is not None:
            self._socket.close(linger=0)
        self._socket = self._monitor = None
        self._connection = _Connection(self._connection.number, now_s)

    def _again(self, text: str, now_s: float, *, wait_s: float = 0.0) -> None:
        """Start a new connection, whose numbers count from 0."""
        if self.connected:
            self._counts.reconnects += 1
        self._emit_event(text)
        self._count_anew()
        self._close(now_s)
        self._wait_until_s = now_s + wait_s

    def _count_anew(self) -> None:
        """Add the dropped and missed products of the ended connection to the totals."""
        self._dropped_before, self._missed_before = self._counts.dropped, self._counts.missed

    def _restarted(self) -> None:
        """Start again on a connection that ZeroMQ has re-established with another publisher at the same address.

        The consumed count continues: a publisher counts from the first value that it receives.
        """
        connection = self._connection
        connection.reader, connection.received, connection.next_number = ProductReader(), 0, 0
        self._counts.reconnects += 1
        self._count_anew()

    def _refuse(self, text: str, now_s: float) -> None:
        self._refusals.append(text)
        if not self._was_connected and len(self._refusals) >= _REFUSALS:
            raise RefusedError(f"{self._address}: {text}")
        self._again(text, now_s, wait_s=min(_MAX_AGAIN_S, _AGAIN_S * len(self._refusals)))

    def _emit_event(self, text: str) -> None:
        """Call back with a text, once until the publisher answers again."""
        if text and text != self._reported:
            self._reported = text
            self._note(text)

    def _subscribe(self, now_s: float) -> None:
        """Send the subscription, each second and after a product was taken."""
        connection = self._connection
        while self._taken:
            if self._taken.popleft() == connection.number:
                connection.taken += 1
                self._ask = True
        beat = connection.asked_s is None or now_s - connection.asked_s >= PING_INTERVAL_S
        if not (beat or self._ask):
            return
        wanted = Subscribe(
            sensors=self._sensors, products=self._products, consumed=connection.taken, credit=self._credit
        )
        if self._send(wanted):
            self._ask = False
            if beat:
                connection.asked_s = now_s
                connection.first_asked_s = connection.first_asked_s or now_s
                self._send(Ping())

    def _send(self, message: Message) -> bool:
        """Send a message if the connection has room for it."""
        if self._socket is None:
            return False
        with suppress(zmq.Again):
            self._socket.send(encode(message), zmq.NOBLOCK)
            return True
        return False

    def _read_all(self) -> None:
        for _ in range(_AT_ONCE):
            if self._socket is None:
                return
            try:
                frames = self._socket.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            try:
                self._read([frame.buffer for frame in frames])
            except FormatVersionError as error:
                self._refuse(str(error), time.monotonic())
            except RefusedError:
                raise
            except ErtisError as error:
                self._counts.damaged += 1
                self._again(str(error), time.monotonic())

    def _read(self, frames: list[memoryview]) -> None:
        message = decode(frames[0], _EXPECTED)
        connection = self._connection
        if isinstance(message, Refused):
            self._refuse(message.reason, time.monotonic())
            return
        if not self.connected:
            self._was_connected, self._refusals = True, []
            self._emit_event("connected")
            self._reported = ""
        connection.heard_s = time.monotonic()
        if isinstance(message, Description):
            if message.number in connection.reader:
                self._restarted()
            connection.reader.describe(message, frames[1:])
        elif not isinstance(message, Pong):
            self._take(message, frames[1:])

    def _take(self, header: Header, payload: list[memoryview]) -> None:
        """Deliver a product, and count the missing ones before it."""
        connection = self._connection
        if header.number < connection.next_number:  # Numbers must rise.
            self._restarted()
        item = connection.reader.read(header, payload)
        arrived_ns, arrived_utc_ns = time.monotonic_ns(), time.time_ns()
        connection.received += 1
        connection.next_number = header.number + 1
        self._counts.missed = self._missed_before + connection.next_number - connection.received
        self._counts.dropped = max(self._counts.dropped, self._dropped_before + header.dropped)
        arrival = Arrival(item, header, arrived_ns, arrived_utc_ns, connection.number)
        if isinstance(header, Image | Points | Raw):
            about = connection.reader.description(header.description)
            arrival = replace(arrival, translation_m=about.translation_m, rotation_xyzw=about.rotation_xyzw)
        self._deliver(arrival)


def _wait(woken: WakeupSocket, timeout_s: float) -> None:
    poller = zmq.Poller()
    poller.register(woken, zmq.POLLIN)
    poller.poll(max(1, round(1000 * timeout_s)))
