"""Requests of admins for new settings of a sensor, which the central node forwards."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import received_settings
from ertis_numba.journal import JournalSensor
from ertis_numba.network import messages
from ertis_numba.network.message_fields import as_line
from ertis_numba.network.messages import Configure, Configured
from ertis_numba.settings import Settings

__all__ = ["RequestQueue", "SettingsRequest"]

_MAX_ANSWERS = 64
_MAX_SENSORS = 32


@dataclass(frozen=True, slots=True)
class SettingsRequest:
    """Request for new settings of a sensor; answer it with `accept` or `refuse`."""

    sensor: str
    settings: Settings
    _request_id: int
    _answer: Callable[[Configured], None]

    def accept(self, sensors: Sequence[str]) -> None:
        """Report that sensors measure with the settings from now on; any thread may call this."""
        named = tuple(sensors)[:_MAX_SENSORS]
        self._answer(Configured(sensor=self.sensor, request_id=self._request_id, sensors=named))

    def refuse(self, reason: str) -> None:
        """Report that the former settings are still in use; any thread may call this."""
        self._answer(Configured(sensor=self.sensor, request_id=self._request_id, error=as_line(reason)))


class RequestQueue:
    """Reader of requests, refused without on_request; calls wake when there is an answer to send."""

    def __init__(self, on_request: Callable[[SettingsRequest], None] | None, wake: Callable[[], None]) -> None:
        self._on_request, self._wake = on_request, wake
        self._answers: deque[Configured] = deque(maxlen=_MAX_ANSWERS)

    def take(self, message: Configure, payload: Sequence[memoryview]) -> None:
        """Pass a request on, or refuse it."""
        if self._on_request is None:
            self._refuse(message, "this sensor node does not accept settings; start it without --fixed-settings")
            return
        try:
            settings = received_settings(b"".join(payload), f"settings for sensor {message.sensor}")
            n_bytes = JournalSensor.from_settings(message.sensor, settings).n_bytes
        except ArgumentError as error:
            self._refuse(message, str(error))
            return
        if n_bytes > message.max_bytes:
            self._refuse(
                message,
                f"a measurement would have {n_bytes} bytes, but the central node accepts at most {message.max_bytes}; "
                "record fewer samples, or raise its limit (--max-bytes)",
            )
            return
        self._on_request(SettingsRequest(message.sensor, settings, message.request_id, self._put))

    def _refuse(self, message: Configure, reason: str) -> None:
        self._put(Configured(sensor=message.sensor, request_id=message.request_id, error=as_line(reason)))

    def _put(self, answer: Configured) -> None:
        self._answers.append(answer)
        self._wake()

    def send(self, send: Callable[[bytes], bool]) -> None:
        """Send waiting answers, as long as there is room."""
        while self._answers and send(messages.encode(self._answers[0])):
            self._answers.popleft()
