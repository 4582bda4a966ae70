"""Requests of admins for new settings of a sensor, from the admin to the sensor node and back."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from ertis_numba.network.central_node._admission import Unwanted
from ertis_numba.network.messages import Configure, Configured
from ertis_numba.settings import Settings

__all__ = ["SettingsRequests"]

_MAX_OPEN: Final = 64
_PATIENCE_S: Final = 120.0  # An answer that comes later is discarded.


@dataclass(frozen=True, slots=True)
class _OpenRequest:
    """Forwarded request that has no answer yet."""

    admin_id: bytes
    sensor: str
    forwarded_s: float


class SettingsRequests:
    """Forwards requests and their answers.

    Parameters
    ----------
    send : callable
        Called with a peer, a message to it and its payload.
    nodes_of : callable
        Returns the sensor nodes that send a sensor.
    max_bytes : int
        Size of the largest accepted measurement.
    """

    def __init__(self, send: Callable[..., None], nodes_of: Callable[[str], list[bytes]], *, max_bytes: int) -> None:
        self._send, self._nodes_of, self._max_bytes = send, nodes_of, max_bytes
        self._open: dict[int, _OpenRequest] = {}

    def forward(self, admin_id: bytes, request: Configure, payload: list[bytes]) -> None:
        """Forward a request to the sensor node.

        Raises
        ------
        Unwanted
            No node, or several, send the sensor; the settings are missing or too long; or there are too many requests.
        """
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
        if len(self._open) >= _MAX_OPEN:
            raise Unwanted("size", f"{_MAX_OPEN} requests for settings have no answer yet; wait for them", "too many")
        self._open[request.request_id] = _OpenRequest(admin_id, request.sensor, time.monotonic())
        forwarded = Configure(sensor=request.sensor, request_id=request.request_id, max_bytes=self._max_bytes)
        self._send(nodes[0], forwarded, payload[0])

    def answer(self, answer: Configured) -> None:
        """Forward an answer to the admin; one without a request has come too late."""
        found = self._open.get(answer.request_id)
        if found is not None and found.sensor == answer.sensor:
            del self._open[answer.request_id]
            self._send(found.admin_id, answer)

    def _forget_old(self) -> None:
        oldest_s = time.monotonic() - _PATIENCE_S
        self._open = {number: each for number, each in self._open.items() if each.forwarded_s >= oldest_s}
