"""Client of a central node: requests its status, and changes the settings of sensors."""

import secrets
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, Self, TypeVar

import zmq

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, NetworkError, RefusedError
from ertis_numba.journal import JournalSensor
from ertis_numba.network import addresses, messages
from ertis_numba.network.connection import Connection
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.messages import AskStatus, Configure, Configured, Message, Refused, Report
from ertis_numba.network.owner import Owner
from ertis_numba.network.status import Status
from ertis_numba.settings import Settings

__all__ = ["CentralClient"]

_REPORT_BYTES: Final = 4_000_000
_AGAIN_S: Final = 0.5
_TURN_S: Final = 0.1

Answer = TypeVar("Answer")


class CentralClient:
    """Client of a central node; use it in a ``with`` statement.

    Several threads may use one client. Their requests take turns; use a client for each thread to avoid waiting.

    Parameters
    ----------
    address : str
        Address for sensor nodes; for the status, also the address for applications.
    keys : ClientKeys, optional
        Keys of an application or an admin; of an admin to change settings.

    Raises
    ------
    ArgumentError
        The address cannot be used, or requires keys.

    Examples
    --------
    >>> with CentralClient("tcp://127.0.0.1:5601") as central:  # doctest: +SKIP
    ...     print(central.status().state)
    ...     central.configure("front", Settings.from_preset("short_25_50"))
    """

    def __init__(self, address: str, *, keys: ClientKeys | None = None) -> None:
        if keys is not None:
            checks.instance("keys", keys, ClientKeys, "ertis_numba.network.keys defines")
        self._address, self._keys = addresses.endpoint(address), keys
        addresses.require_keys(self._address, keys=keys)
        self._turn = threading.Lock()
        self._closing = threading.Event()
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._connection: Connection | None = None

    def __enter__(self) -> Self:
        self._closing.clear()
        self._owner = Owner("client")
        self._context = zmq.Context()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._owner.is_this_process:
            return
        self._closing.set()
        with self._turn:
            self._hang_up()
            if self._context is not None:
                self._context.destroy(linger=0)
            self._context = None

    def status(self, patience_s: float = 3.0) -> Status:
        """Return the status.

        Parameters
        ----------
        patience_s : float
            Timeout.

        Raises
        ------
        ArgumentError
            The timeout is not above zero.
        NetworkError
            There was no answer within the timeout.
        RefusedError
            The central node refuses this node, or its request.
        DataError
            The answer is not of this protocol.
        """
        checks.positive("patience_s", patience_s)

        def status_of(message: Message, payload: Sequence[memoryview]) -> Status | None:
            return Status.decode(b"".join(payload)) if isinstance(message, Report) else None

        return self._exchange([messages.encode(AskStatus())], status_of, patience_s, again_s=_AGAIN_S)

    def configure(self, sensor: str, settings: Settings, patience_s: float = 30.0) -> tuple[str, ...]:
        """Change the settings of a sensor, and return once it measures with them.

        The sensor node configures all its sensors between two measurements. If one cannot use the settings, all keep
        their former ones. The measurements that follow belong to a new session.

        Parameters
        ----------
        sensor : str
            Name of the sensor.
        settings : Settings
        patience_s : float
            Timeout in seconds. After it, the sensor may still apply the settings.

        Returns
        -------
        tuple of str
            Sensors with the new settings, at most 32.

        Raises
        ------
        ArgumentError
            The settings cannot belong to a recording, or an argument has a wrong type.
        NetworkError
            There was no answer within the timeout.
        RefusedError
            The central node refuses this node, no sensor node sends the sensor, the sensor node leaves, or one of both
            nodes refuses the settings. A central node that computes images refuses settings without an image.
        """
        if not isinstance(sensor, str):
            raise ArgumentError(f"sensor is of type {type(sensor).__name__}; pass the name of a sensor")
        checks.instance("settings", settings, Settings, "Settings.load returns")
        checks.positive("patience_s", patience_s)
        request_id = secrets.randbits(62)
        text = JournalSensor.from_settings(sensor, settings).settings.to_toml().encode()

        def sensors_of(message: Message, _: Sequence[memoryview]) -> tuple[str, ...] | None:
            if not isinstance(message, Configured) or message.request_id != request_id:
                return None
            if message.error:
                raise RefusedError(f"sensor {sensor} keeps its settings: {message.error}")
            return message.sensors

        frames = [messages.encode(Configure(sensor=sensor, request_id=request_id)), text]
        silent = (
            f"the sensor node of {sensor} did not answer within {patience_s:g} s, and may still apply the settings; "
            "check with 'ertis sensors status' that it still sends, or allow more time"
        )
        return self._exchange(frames, sensors_of, patience_s, silent=silent)

    def _exchange(
        self,
        frames: list[bytes],
        answer_in: Callable[[Message, Sequence[memoryview]], Answer | None],
        patience_s: float,
        *,
        again_s: float | None = None,
        silent: str = "",
    ) -> Answer:
        """Repeat a request until it is answered, once without again_s; threads take turns."""
        with self._turn:
            return self._exchange_alone(frames, answer_in, patience_s, again_s=again_s, silent=silent)

    def _exchange_alone(
        self,
        frames: list[bytes],
        answer_in: Callable[[Message, Sequence[memoryview]], Answer | None],
        patience_s: float,
        *,
        again_s: float | None,
        silent: str,
    ) -> Answer:
        end_s, sent_s, why = time.monotonic() + patience_s, -float("inf"), ""
        while time.monotonic() < end_s:
            connection = self._opened()
            is_due = sent_s < 0 if again_s is None else time.monotonic() - sent_s > again_s
            if is_due and connection.send(*frames):
                sent_s = time.monotonic()
            connection.wait(min(_TURN_S, patience_s))
            while received := connection.receive():
                message = messages.decode(received[0])
                if isinstance(message, Refused):
                    raise RefusedError(message.reason)
                answer = answer_in(message, received[1:])
                if answer is not None:
                    return answer
            why = next(iter(connection.refusals()), why)
            if connection.has_ended:
                break
        self._hang_up()
        if why:
            raise RefusedError(f"{self._address}: {why}")
        if silent and sent_s > 0:
            raise NetworkError(silent)
        raise NetworkError(
            f"no answer from {self._address} within {patience_s:g} s; start a central node there with 'ertis "
            "record' or 'ertis serve', or correct the address"
        )

    def _opened(self) -> Connection:
        if self._context is None or self._closing.is_set():
            raise NetworkError("this client is not open; use it in a with statement")
        self._owner.require_this_process()
        if self._connection is None:
            self._connection = Connection(self._context, self._address, keys=self._keys, max_bytes=_REPORT_BYTES)
        return self._connection

    def _hang_up(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection = None
