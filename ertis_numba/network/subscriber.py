"""Application node that receives images, points, measurements and groups."""

import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, Literal, TypedDict, TypeVar, Unpack, cast, overload

import zmq

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.network import addresses
from ertis_numba.network._subscription import SubscriberCounts, Subscription
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.messages import PRODUCTS, Group, Product
from ertis_numba.network.owner import Owner
from ertis_numba.network.products import Arrival, trace
from ertis_numba.network.receiving_loop import ReceivingLoop
from ertis_numba.network.wakeup_socket import WakeupSocket

if TYPE_CHECKING:
    from ertis_numba.frames import Energyscape, Measurement, PointCloud
    from ertis_numba.network.products import Item
    from ertis_numba.network.status import Status

__all__ = ["Arrival", "Subscriber", "SubscriberCounts"]

Kind_co = TypeVar("Kind_co", covariant=True)

_MAX_SENSORS: Final = 32
_STOP_S: Final = 5.0


class _Options(TypedDict, total=False):
    sensors: Sequence[str] | None
    keys: ClientKeys | None
    on_note: Callable[[str], None] | None
    credit: int


class Subscriber(ReceivingLoop[Kind_co]):
    """Receiver of a central node's products; use it in a ``with`` statement and a loop.

    The loop ends when another thread or a signal handler calls `close`. The subscriber reconnects to a central node
    that was away. The central node drops and counts products for a slow application, and always keeps the latest.

    Parameters
    ----------
    address : str
        Address at which the central node publishes, ``tcp://HOST:PORT``.
    sensors : sequence of str, optional
        All by default.
    products : sequence of {"energyscape", "points", "raw", "group", "status"}
    keys : ClientKeys, optional
        None on loopback only.
    on_note : callable, optional
        Called by a thread with a line for each change of the connection.
    credit : int
        Limit on products under way or waiting here. A higher limit gives a higher rate over a slow connection, and
        older products to a slow application.

    Attributes
    ----------
    latest : Arrival or None
        Details of the last received product: its number and times, and the mounting of its sensor.
    counts : SubscriberCounts

    Raises
    ------
    ArgumentError
        The address, a sensor or a product cannot be used, or the address requires keys.

    Examples
    --------
    >>> with Subscriber("tcp://127.0.0.1:5602", sensors=["front"], products=["points"]) as subscriber:  # doctest: +SKIP
    ...     for cloud in subscriber:
    ...         print(cloud.stamp.sequence, cloud.position_m.min(axis=0))
    """

    @overload
    def __init__(
        self: "Subscriber[Energyscape]",
        address: str,
        *,
        products: Sequence[Literal["energyscape"]] = ...,
        **options: Unpack[_Options],
    ) -> None: ...
    @overload
    def __init__(
        self: "Subscriber[PointCloud]",
        address: str,
        *,
        products: Sequence[Literal["points"]],
        **options: Unpack[_Options],
    ) -> None: ...
    @overload
    def __init__(
        self: "Subscriber[Measurement]",
        address: str,
        *,
        products: Sequence[Literal["raw"]],
        **options: Unpack[_Options],
    ) -> None: ...
    @overload
    def __init__(
        self: "Subscriber[Group]",
        address: str,
        *,
        products: Sequence[Literal["group"]],
        **options: Unpack[_Options],
    ) -> None: ...
    @overload
    def __init__(
        self: "Subscriber[Status]",
        address: str,
        *,
        products: Sequence[Literal["status"]],
        **options: Unpack[_Options],
    ) -> None: ...
    @overload
    def __init__(
        self: "Subscriber[Item]",
        address: str,
        *,
        products: Sequence[Product],
        **options: Unpack[_Options],
    ) -> None: ...
    def __init__(
        self: "Subscriber[Any]",
        address: str,
        *,
        products: Sequence[Product] = ("energyscape",),
        sensors: Sequence[str] | None = None,
        keys: ClientKeys | None = None,
        on_note: Callable[[str], None] | None = None,
        credit: int = 2,
    ) -> None:
        address = addresses.endpoint(address)
        addresses.require_keys(address, keys=keys)
        given: list[Product] = (
            [cast("Product", products)] if isinstance(products, str) else list(dict.fromkeys(products))
        )
        for product in given:
            checks.choice("product", product, PRODUCTS)
        if not given:
            raise ArgumentError(f"products is empty; choose from {', '.join(PRODUCTS)}")
        named = None if sensors is None else tuple([sensors] if isinstance(sensors, str) else dict.fromkeys(sensors))
        if named is not None and not 0 < len(named) <= _MAX_SENSORS:
            raise ArgumentError(f"sensors lists {len(named)} names; use 1 to {_MAX_SENSORS}, or None for all")
        for sensor in named or ():
            checks.sensor_name(sensor)
        checks.integer("credit", credit, 1, 64)
        self.latest: Arrival | None = None
        self.counts = SubscriberCounts()
        # A signal handler may put to this kind of queue even if it has interrupted a thread that is taking from it.
        self._waiting: queue.SimpleQueue[Arrival | Exception | None] = queue.SimpleQueue()
        self._closed = False
        self._owner = Owner("subscriber")
        self._wakeup_socket = WakeupSocket()
        self._subscription = Subscription(
            address,
            sensors=named,
            products=tuple(given),
            keys=keys,
            on_note=on_note or (lambda _: None),
            credit=credit,
            counts=self.counts,
            deliver=self._waiting.put,
        )
        self._thread = threading.Thread(target=self._run, name="ertis-subscriber", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Return True if a publisher answers."""
        return self._subscription.connected

    @property
    def n_skipped(self) -> int:
        """Return 0: the central node drops products for a slow application, and counts them."""
        return 0

    @property
    def closed(self) -> bool:
        """Return True after `close`."""
        return self._closed

    def receive(self, timeout_s: float | None = None) -> Kind_co | None:
        """Return the next product; None after ``timeout_s``, or once the subscriber is closed.

        Parameters
        ----------
        timeout_s : float, optional
            Time to wait; unlimited by default.

        Raises
        ------
        RefusedError
            The central node has refused this application from the start. After a first acceptance, the subscriber keeps
            trying.
        """
        self._owner.require_this_process()
        try:
            arrival = self._waiting.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if not isinstance(arrival, Arrival):
            self._waiting.put(arrival)  # The next caller gets it as well.
        if arrival is None or self._closed:
            return None
        if isinstance(arrival, Exception):
            raise arrival
        trace("taken", arrival.header)
        self.latest = arrival
        self.counts.received += 1
        self._subscription.taken(arrival)
        self._wakeup_socket.wake()
        return cast("Kind_co", arrival.item)

    def close(self) -> None:
        """End the loop; waiting products are lost."""
        self._closed = True
        if not self._owner.is_this_process:
            return
        with suppress(queue.Empty):
            while True:
                self._waiting.get_nowait()
        self._waiting.put(None)
        self._wakeup_socket.wake()
        if threading.current_thread() is not self._thread:
            self._thread.join(_STOP_S)

    def _run(self) -> None:
        """Serve the connection until `close`."""
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(io_threads=1)
        try:
            with self._subscription.within(context):
                while not self._closed:
                    self._subscription.turn(self._wakeup_socket, time.monotonic())
                    self._wakeup_socket.clear()
        except Exception as error:  # noqa: BLE001  whatever it is, who waits must not do so for ever
            self._waiting.put(error)
        finally:
            context.destroy(linger=0)
            self._wakeup_socket.close()
