"""Requests of admins for new settings of a sensor, from the admin to the sensor node and back."""

import time
from collections import deque
from collections.abc import Callable, Container
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import received_settings
from ertis_numba.network.central_node._admission import Unwanted
from ertis_numba.network.message_fields import as_line
from ertis_numba.network.messages import Configure, Configured, Pong
from ertis_numba.network.wakeup_socket import WakeupSocket
from ertis_numba.settings import Settings

__all__ = ["SettingsRequests"]

_PREFIX: Final = "no image could be computed from measurements with them: "


class SettingsCheck:
    """Checker of requests in their order, in a thread; require raises ArgumentError for unusable settings."""

    def __init__(self, require: Callable[[Settings], None]) -> None:
        self._require = require
        self._done: deque[tuple[int, bytes, str]] = deque()
        self._thread: ThreadPoolExecutor | None = None
        self._wakeup_socket: WakeupSocket | None = None

    def open(self) -> int:
        """Start the thread, and return a descriptor to poll; call `take` when it is readable."""
        self._wakeup_socket = WakeupSocket()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="settings check")
        return self._wakeup_socket.fileno()

    def close(self) -> None:
        """End the thread; closing twice does no harm."""
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)
            self._thread = None
        if self._wakeup_socket is not None:
            self._wakeup_socket.close()
            self._wakeup_socket = None

    def offer(self, request_id: int, sensor: str, text: bytes) -> None:
        """Queue the settings of a request; never blocks."""
        if self._thread is not None:
            self._thread.submit(self._check, request_id, sensor, text)

    def take(self) -> list[tuple[int, bytes, str]]:
        """Return (identifier, settings, fault or empty text) of newly checked requests, without blocking."""
        if self._wakeup_socket is not None:
            self._wakeup_socket.clear()
        return [self._done.popleft() for _ in range(len(self._done))]

    def _check(self, request_id: int, sensor: str, text: bytes) -> None:
        fault = self._fault(sensor, text)
        self._done.append((request_id, text, fault))
        if self._wakeup_socket is not None:
            self._wakeup_socket.wake()

    def _fault(self, sensor: str, text: bytes) -> str:
        try:
            settings = received_settings(text, f"settings for sensor {sensor}")
        except ArgumentError as error:
            return str(error)
        try:
            self._require(settings)
        except ArgumentError as error:
            return _PREFIX + str(error)
        except Exception as error:  # noqa: BLE001  the request is answered whatever it is
            return f"{_PREFIX}{type(error).__name__} {error}"
        return ""


_MAX_OPEN: Final = 64
_PATIENCE_S: Final = 120.0  # An answer that comes later is discarded.
_LEFT: Final = (
    "its sensor node has left before it answered; start 'ertis capture --to' again, which uses its own settings"
)


@dataclass(frozen=True, slots=True)
class _OpenRequest:
    """Forwarded request that has no answer yet."""

    admin_id: bytes
    node_id: bytes
    sensor: str
    asked_s: float


class SettingsRequests:
    """Forwarder of checked requests and their answers; send returns False if the peer is gone."""

    def __init__(
        self,
        send: Callable[..., bool],
        nodes_of: Callable[[str], list[bytes]],
        *,
        max_bytes: int,
        require: Callable[[Settings], None] | None = None,
    ) -> None:
        self._send, self._nodes_of, self._max_bytes = send, nodes_of, max_bytes
        self._check = None if require is None else SettingsCheck(require)
        self._open: dict[int, _OpenRequest] = {}

    def open(self) -> int:
        """Start checking, and return a descriptor to poll; -1 if nothing is checked."""
        return -1 if self._check is None else self._check.open()

    def close(self) -> None:
        """Stop checking; closing twice does no harm."""
        if self._check is not None:
            self._check.close()

    def forward(self, admin_id: bytes, request: Configure, payload: list[bytes]) -> None:
        """Forward a checked request to the only sensor node, or refuse it."""
        self._forget_old()
        if len(payload) != 1 or len(payload[0]) > Settings.max_bytes:
            raise Unwanted(
                "settings",
                f"settings are missing, or exceed {Settings.max_bytes} bytes; send one settings text",
                "size",
            )
        nodes = self._nodes_of(request.sensor)
        if len(nodes) != 1:
            count = f"{len(nodes)} sensor nodes send" if nodes else "no sensor node sends"
            remedy = "end all of them but one" if nodes else "start 'ertis capture --to', or correct the name"
            raise Unwanted("sensor", f"{count} sensor {request.sensor}; {remedy}", "message")
        if request.request_id in self._open:
            raise Unwanted(
                "size",
                f"request {request.request_id} has no answer yet; wait for it, or use another number",
                "too many",
            )
        if len(self._open) >= _MAX_OPEN:
            raise Unwanted("size", f"{_MAX_OPEN} requests for settings have no answer yet; wait for them", "too many")
        self._open[request.request_id] = _OpenRequest(admin_id, nodes[0], request.sensor, time.monotonic())
        if self._check is None:
            self._pass_on(request.request_id, payload[0])
        else:
            self._check.offer(request.request_id, request.sensor, payload[0])

    def take(self) -> None:
        """Forward requests that were checked, and refuse those with a fault."""
        for request_id, text, fault in () if self._check is None else self._check.take():
            if fault:
                self._refuse(request_id, fault)
            else:
                self._pass_on(request_id, text)

    def answer(self, answer: Configured) -> None:
        """Forward an answer to the admin; one without a request has come too late."""
        found = self._open.get(answer.request_id)
        if found is not None and found.sensor == answer.sensor:
            del self._open[answer.request_id]
            self._send(found.admin_id, answer)

    def tick(self, nodes: Container[bytes], sign_of_life: Pong) -> None:
        """Answer requests whose node is gone; sign_of_life reveals a broken connection of the others early."""
        for request_id, request in list(self._open.items()):
            if request.node_id not in nodes or not self._send(request.node_id, sign_of_life):
                self._refuse(request_id, _LEFT)

    def _pass_on(self, request_id: int, text: bytes) -> None:
        found = self._open.get(request_id)
        if found is not None:
            forwarded = Configure(sensor=found.sensor, request_id=request_id, max_bytes=self._max_bytes)
            self._send(found.node_id, forwarded, text)

    def _refuse(self, request_id: int, reason: str) -> None:
        found = self._open.pop(request_id, None)
        if found is not None:
            self._send(found.admin_id, Configured(sensor=found.sensor, request_id=request_id, error=as_line(reason)))

    def _forget_old(self) -> None:
        oldest_s = time.monotonic() - _PATIENCE_S
        self._open = {number: each for number, each in self._open.items() if each.asked_s >= oldest_s}
