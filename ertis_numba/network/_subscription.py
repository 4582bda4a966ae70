"""Connection of an application to a publisher: requests, products and reconnection."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

import zmq

from ertis_numba.base.errors import ErtisError, FormatVersionError, RefusedError
from ertis_numba.network.connection import Connection
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.messages import (
    SILENCE_LIMIT_S,
    Bye,
    Description,
    Pong,
    Product,
    Refused,
    Subscribe,
    decode,
    encode,
)
from ertis_numba.network.product_messages import PRODUCT_MESSAGES, MeasuredProduct, ProductMessage
from ertis_numba.network.products import Arrival, ProductReader, trace
from ertis_numba.network.wakeup_socket import WakeupSocket

__all__ = ["SubscriberCounts", "Subscription"]

_EXPECTED: Final = (Description, *PRODUCT_MESSAGES, Pong, Refused)
_UNMADE_S: Final = 5.0  # ZeroMQ gives up after a refusal, whose event may precede the monitor.
_AGAIN_S: Final = 0.5
_MAX_AGAIN_S: Final = 5.0
_REFUSALS: Final = 3  # Limit on refusals before the first answer, after which retrying is useless.
_TURN_S: Final = 0.1
_AT_ONCE: Final = 64


@dataclass(slots=True)
class SubscriberCounts:
    """Counts of an application's products."""

    received: int = 0  # taken by the application
    dropped: int = 0  # by the publisher, because the application was slow
    missed: int = 0  # never arrived: dropped, except for any still on their way
    reconnects: int = 0
    damaged: int = 0  # invalid messages; each ends a connection


@dataclass(slots=True)
class _Numbers:
    """Counts since a connection was made."""

    connection: int
    taken: int = 0
    received: int = 0
    next_number: int = 0
    reader: ProductReader = field(default_factory=ProductReader)


class Subscription:
    """Client that requests products and reads them in one thread; another thread may call only `taken`."""

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
        self._connection: Connection | None = None
        self._numbers = _Numbers(0)
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
        return self._connection is not None and self._connection.heard_s is not None

    def taken(self, arrival: Arrival) -> None:
        """Register that the application has taken a product, so that another may be sent."""
        self._taken.append(arrival.connection)

    @contextmanager
    def within(self, context: "zmq.Context[zmq.Socket[bytes]]") -> Iterator[None]:
        """Use a context until the block ends."""
        self._context = context
        try:
            yield
            if self._connection is not None:
                self._connection.send(encode(Bye()))
        finally:
            self._close()

    def turn(self, woken: WakeupSocket, now_s: float) -> None:
        """Do pending work, or wait up to 0.1 s; raise RefusedError if the publisher never accepted this application."""
        connection = self._connection
        if connection is None:
            if now_s < self._wait_until_s:
                _wait(woken, min(_TURN_S, self._wait_until_s - now_s))
                return
            connection = self._open()
        self._subscribe(connection, now_s)
        connection.wait(_TURN_S, woken)
        for text in connection.refusals()[-1:]:
            self._refuse(text, time.monotonic())
            return
        self._read_all(connection)
        if connection is not self._connection:
            return
        since_s, now_s = connection.heard_s or connection.sent_s, time.monotonic()
        if since_s is not None and now_s - since_s > SILENCE_LIMIT_S:
            self._again(f"the publisher has been silent for {SILENCE_LIMIT_S:g} s; connecting again", now_s)
        elif since_s is None and now_s - connection.opened_s > _UNMADE_S:
            self._again("", now_s)

    def _open(self) -> Connection:
        self._connection = Connection(self._context, self._address, keys=self._keys)
        self._numbers = _Numbers(self._numbers.connection + 1)
        self._ask = True
        return self._connection

    def _close(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection = None
        self._numbers = _Numbers(self._numbers.connection)

    def _again(self, text: str, now_s: float, *, wait_s: float = 0.0) -> None:
        """Start a new connection, whose numbers count from 0."""
        if self.connected:
            self._counts.reconnects += 1
        self._emit_event(text)
        self._count_anew()
        self._close()
        self._wait_until_s = now_s + wait_s

    def _count_anew(self) -> None:
        """Add the dropped and missed products of the ended connection to the totals."""
        self._dropped_before, self._missed_before = self._counts.dropped, self._counts.missed

    def _restarted(self) -> None:
        """Start again on a connection to another publisher, which ZeroMQ has made at the same address."""
        numbers = self._numbers
        numbers.reader, numbers.received, numbers.next_number = ProductReader(), 0, 0
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

    def _subscribe(self, connection: Connection, now_s: float) -> None:
        """Send the subscription, with each ping and after a product was taken."""
        while self._taken:
            if self._taken.popleft() == self._numbers.connection:
                self._numbers.taken += 1
                self._ask = True
        if not (self._ask or connection.ping_is_due(now_s)):
            return
        wanted = Subscribe(
            sensors=self._sensors, products=self._products, consumed=self._numbers.taken, credit=self._credit
        )
        if connection.send(encode(wanted)):
            self._ask = False
            connection.ping(now_s)

    def _read_all(self, connection: Connection) -> None:
        for _ in range(_AT_ONCE):
            if connection is not self._connection:
                return
            frames = connection.receive()
            if frames is None:
                return
            try:
                self._read(connection, frames)
            except FormatVersionError as error:
                self._refuse(str(error), time.monotonic())
            except RefusedError:
                raise
            except ErtisError as error:
                self._counts.damaged += 1
                self._again(str(error), time.monotonic())

    def _read(self, connection: Connection, frames: list[memoryview]) -> None:
        message = decode(frames[0], _EXPECTED)
        if isinstance(message, Refused):
            self._refuse(message.reason, time.monotonic())
            return
        if not self.connected:
            self._was_connected, self._refusals = True, []
            self._emit_event("connected")
            self._reported = ""
        connection.heard_s = time.monotonic()
        if isinstance(message, Description):
            if message.number in self._numbers.reader:
                self._restarted()
            self._numbers.reader.describe(message, frames[1:])
        elif not isinstance(message, Pong):
            self._take(message, frames[1:])

    def _take(self, header: ProductMessage, payload: list[memoryview]) -> None:
        """Deliver a product, and count the missing ones before it."""
        numbers = self._numbers
        if header.number < numbers.next_number:  # Numbers must rise.
            self._restarted()
        trace("received", header)
        item = numbers.reader.read(header, payload)
        arrived_ns, arrived_utc_ns = time.monotonic_ns(), time.time_ns()
        numbers.received += 1
        numbers.next_number = header.number + 1
        self._counts.missed = self._missed_before + numbers.next_number - numbers.received
        self._counts.dropped = max(self._counts.dropped, self._dropped_before + header.dropped)
        place: tuple[Any, Any] = (None, None)
        if isinstance(header, MeasuredProduct):
            about = numbers.reader.description(header.description)
            place = about.translation_m, about.rotation_xyzw
        self._deliver(Arrival(item, header, arrived_ns, arrived_utc_ns, numbers.connection, *place))


def _wait(woken: WakeupSocket, timeout_s: float) -> None:
    poller = zmq.Poller()
    poller.register(woken, zmq.POLLIN)
    poller.poll(max(1, round(1000 * timeout_s)))
