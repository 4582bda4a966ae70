"""Check of requested settings, in a separate thread: TOML of 256 kB takes a tenth of a second."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import received_settings
from ertis_numba.network.wakeup_socket import WakeupSocket
from ertis_numba.settings import Settings

__all__ = ["SettingsCheck"]

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
