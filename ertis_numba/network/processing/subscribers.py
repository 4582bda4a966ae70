"""Products for each application: as requested, as much as it accepts, the latest first."""

import itertools
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import msgspec
import zmq

from ertis_numba.network.messages import (
    SILENCE_LIMIT_S,
    Message,
    Product,
    Subscribe,
    encode,
)
from ertis_numba.network.product_messages import ProductMessage
from ertis_numba.network.status import SubscriberStatus

__all__ = ["DESCRIPTIONS", "ConnectedSubscriber", "QueuedProduct", "Subscribers"]

DESCRIPTIONS: Final = 4
"""Limit on the descriptions of each sensor: of its images and its samples, before and after a change of settings."""

_MAX: Final = 256
_MAX_OF_KEY: Final = 16
_DESCRIBED: Final = 16  # Number of descriptions of each sensor that an application keeps.
_UNDER_WAY_BYTES: Final = 64_000_000  # Limit on the bytes under way to an application.
_AFTER_S: Final = 60.0  # Time after which a silent application is forgotten.


@dataclass(frozen=True, slots=True, eq=False)
class QueuedProduct:
    """Product to send to its subscribers."""

    product: Product
    sensor: str  # empty for products without one
    header: ProductMessage  # without its numbers
    payloads: "list[bytes | memoryview | zmq.Frame]" = field(default_factory=list)  # frames after `share`
    description: tuple[int, Sequence[bytes]] | None = None  # (number, frames), sent before

    @property
    def n_bytes(self) -> int:
        """Size of the payloads."""
        return sum(map(len, self.payloads))

    def share(self) -> None:
        """Copy payloads into ZeroMQ messages that all subscribers share, so that their memory is free again."""
        self.payloads[:] = [
            each if isinstance(each, zmq.Frame) else zmq.Frame(each, copy=True) for each in self.payloads
        ]


@dataclass(slots=True, eq=False)
class ConnectedSubscriber:
    """A connected application."""

    frames: Sequence[zmq.Frame]  # latest message, to check its key again
    name: str
    wants: Subscribe
    before: int = 0  # Products consumed when it was first heard of.
    heard_s: float = 0.0
    active: bool = True
    number: int = 0  # Number of the next product.
    sent: int = 0
    dropped: int = 0
    described: dict[str, deque[int]] = field(default_factory=dict)  # By sensor.
    under_way: deque[int] = field(default_factory=deque)  # Bytes of each product that it has not consumed yet.
    waiting: dict[tuple[str, str], tuple[int, QueuedProduct]] = field(default_factory=dict)

    def asks_for(self, product: str, sensor: str) -> bool:
        """Return True if it subscribes to a product of a sensor."""
        sensors = self.wants.sensors
        return product in self.wants.products and (not sensor or sensors is None or sensor in sensors)

    @property
    def has_credit(self) -> bool:
        """True if another product may be sent to it."""
        return len(self.under_way) < self.wants.credit and sum(self.under_way) < _UNDER_WAY_BYTES

    def consumed(self, wants: Subscribe) -> None:
        """Update its subscription and its consumed products."""
        self.wants = wants
        left = max(0, self.sent - max(0, wants.consumed - self.before))
        while len(self.under_way) > left:
            self.under_way.popleft()
        for key in [key for key in self.waiting if not self.asks_for(*key)]:
            del self.waiting[key]
            self.dropped += 1

    def offer(self, item: QueuedProduct) -> None:
        """Queue a product until it has credit, unless a newer one replaces it."""
        if not self.asks_for(item.product, item.sensor):
            return
        key = (item.product, item.sensor)
        self.dropped += key in self.waiting
        self.waiting[key] = (self.number, item)
        self.number += 1

    def next(self) -> tuple[tuple[str, str], int, QueuedProduct] | None:
        """Return the next product to send, if any."""
        if not self.waiting or not self.has_credit:
            return None
        key = min(self.waiting, key=lambda each: self.waiting[each][0])
        return key, *self.waiting[key]

    def was_sent(self, key: tuple[str, str]) -> None:
        """Register a product as under way."""
        _, item = self.waiting.pop(key)
        self.under_way.append(item.n_bytes)
        self.sent += 1

    def retire(self) -> None:
        """Suspend its subscription until it sends it again; its numbers continue."""
        self.active = False
        self.dropped += len(self.waiting)
        self.waiting.clear()


class Subscribers:
    """All applications, with their common ROUTER; with keys, each key may use a share of the places only."""

    def __init__(self, socket: "zmq.Socket[bytes]", *, with_keys: bool = False) -> None:
        self._socket = socket
        self._max_of_key = _MAX_OF_KEY if with_keys else _MAX
        self._all: dict[bytes, ConnectedSubscriber] = {}
        self._descriptions: dict[str, dict[int, Sequence[bytes]]] = {}

    def __iter__(self) -> Iterator[ConnectedSubscriber]:
        return (each for each in self._all.values() if each.active)

    def hear(self, frames: Sequence[zmq.Frame], name: str, wants: Subscribe) -> bool:
        """Update the subscription of an application; return True if it is known, or new and there is room for it."""
        routing_id, now_s = frames[0].bytes, time.monotonic()
        known = self._all.get(routing_id)
        if known is None:
            if not self._has_room(name):
                return False
            known = self._all[routing_id] = ConnectedSubscriber(frames, name, wants, before=wants.consumed)
        known.frames, known.heard_s, known.active = frames, now_s, True
        known.consumed(wants)
        self._send(routing_id, known)
        return True

    def _has_room(self, name: str) -> bool:
        """Return True if a key may have another application; its silent ones make room."""
        of_key = {routing_id: each for routing_id, each in self._all.items() if each.name == name}
        silent = [routing_id for routing_id, each in of_key.items() if not each.active]
        if len(of_key) >= self._max_of_key and silent:
            self.forget(min(silent, key=lambda routing_id: of_key[routing_id].heard_s))
            return self._has_room(name)
        return len(of_key) < self._max_of_key and sum(1 for _ in self) < _MAX

    def forget(self, routing_id: bytes) -> None:
        """Remove an application."""
        self._all.pop(routing_id, None)

    def describe(self, sensor: str, number: int, frames: Sequence[bytes]) -> None:
        """Keep the description of products for their subscribers."""
        kept = self._descriptions.setdefault(sensor, {})
        kept[number] = frames
        while len(kept) > DESCRIPTIONS:
            del kept[min(kept)]

    def description(self, sensor: str, number: int) -> tuple[int, Sequence[bytes]] | None:
        """Return the description of a sensor's products for a `QueuedProduct`; None if it is not known (any more)."""
        frames = self._descriptions.get(sensor, {}).get(number)
        return None if frames is None else (number, frames)

    def wanted(self, product: Product, sensor: str) -> bool:
        """Return True if an application subscribes to a product of a sensor."""
        return any(each.asks_for(product, sensor) for each in self)

    def sensors_for(self, product: Product) -> tuple[str, ...] | None:
        """Return the sensors of a subscribed product; None stands for all."""
        asked = [each.wants.sensors for each in self if product in each.wants.products]
        if any(sensors is None for sensors in asked):
            return None
        return tuple(sorted(set(itertools.chain.from_iterable(sensors or () for sensors in asked))))

    def offer(self, item: QueuedProduct) -> None:
        """Send a product to subscribers with credit; the others get it, or a newer one, later."""
        if not self.wanted(item.product, item.sensor):
            return
        item.share()
        for routing_id, each in list(self._all.items()):
            if each.active:
                each.offer(item)
                self._send(routing_id, each)

    def tick(self, may_receive: Any) -> None:
        """Suspend silent applications, remove those that no longer ``may_receive``, and send waiting products."""
        now_s = time.monotonic()
        for routing_id, each in list(self._all.items()):
            if now_s - each.heard_s > _AFTER_S or (each.active and not may_receive(each.frames)):
                self.forget(routing_id)
            elif each.active and now_s - each.heard_s > SILENCE_LIMIT_S:
                each.retire()
            elif each.active:
                self._send(routing_id, each)

    def notify(self, message: Message) -> None:
        """Send a message that is not a product to all."""
        header = encode(message)
        for routing_id in [routing_id for routing_id, each in self._all.items() if each.active]:
            self._put(routing_id, [header])

    def status(self) -> tuple[SubscriberStatus, ...]:
        """Return the status of the applications."""
        return tuple(
            SubscriberStatus(
                name=each.name,
                products=each.wants.products,
                sensors=each.wants.sensors,
                sent=each.sent,
                dropped=each.dropped,
            )
            for each in self
        )

    def _send(self, routing_id: bytes, each: ConnectedSubscriber) -> None:
        while (found := each.next()) is not None:
            key, number, item = found
            if item.description is not None:
                about, frames = item.description
                described = each.described.setdefault(item.sensor, deque(maxlen=_DESCRIBED))
                if about not in described:
                    if not self._put(routing_id, frames):
                        return
                    described.append(about)
            changes: dict[str, Any] = {"number": number, "dropped": each.dropped}
            if hasattr(item.header, "published_ns"):
                changes["published_ns"] = time.monotonic_ns()
            header = encode(msgspec.structs.replace(item.header, **changes))
            if not self._put(routing_id, [header, *item.payloads]):
                return
            each.was_sent(key)

    def _put(self, routing_id: bytes, frames: "Iterable[bytes | memoryview | zmq.Frame]") -> bool:
        """Send a message to an application; return True on success, and remove an application that is gone."""
        try:
            self._socket.send_multipart([routing_id, *frames], zmq.NOBLOCK)
        except zmq.Again:
            return False
        except zmq.ZMQError:  # there is no such peer any more
            self.forget(routing_id)
            return False
        return True
