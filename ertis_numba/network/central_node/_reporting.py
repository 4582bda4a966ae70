"""State, status and events of a running central node."""

import os
import socket as names
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from typing import Any, Final

from ertis_numba.journal import SealingResult
from ertis_numba.network import addresses
from ertis_numba.network.central_node._archive import Archive
from ertis_numba.network.central_node._images import Guarded
from ertis_numba.network.central_node._intake import Intake
from ertis_numba.network.central_node._received_items import ReceivedItem
from ertis_numba.network.central_node._server_socket import ServerSocket
from ertis_numba.network.message_fields import State
from ertis_numba.network.status import Status

__all__ = ["Condition", "EventReporter", "text_of"]

_REPORT_S: Final = 0.2  # Maximum age of a requested status.
_VERSION: Final = version("ertis-numba")
_LOG_INTERVAL_S: Final = 1.0  # Interval between events about internal errors.


class Condition:
    """State of a central node: requested address, start by time.monotonic, and the archive's fault, if any."""

    def __init__(
        self,
        listen: str,
        server_socket: ServerSocket,
        intake: Intake,
        *,
        archive: Archive | None,
        images: Guarded | None,
        keys: bool,
    ) -> None:
        self._listen, self._server, self._intake = listen, server_socket, intake
        self._archive, self._images, self._keys = archive, images, keys
        self._report: tuple[float, bytes] = -1.0, b""
        self.begun_s = 0.0
        self.fault = ""
        self.closing = False

    @property
    def address(self) -> str:
        """Actual address, with its port; empty before the node listens."""
        return self._server.address and addresses.at_port(self._listen, self._server.address)

    @property
    def state(self) -> State:
        """Current state."""
        if self.closing:
            return "closing"
        if self.trouble:
            return "fault"
        return "storage" if self._images is None else "processing"

    @property
    def trouble(self) -> str:
        """Current reason why nothing can be stored; empty while storing works."""
        return self.fault or ("" if self._archive is None else self._archive.stuck)

    def status(self) -> Status:
        """Return the status."""
        status = Status(
            version=_VERSION,
            pid=os.getpid(),
            host=names.gethostname(),
            address=self.address,
            state=self.state,
            fault=self.trouble,
            uptime_s=round(time.monotonic() - self.begun_s, 3),
            time_ns=time.time_ns(),
            memory_bytes=_memory_bytes(),
            peers=len(self._intake.peers),
            keys=self._keys,
            keys_note=self._server.note,
            refused=dict(self._server.refused + (Counter() if self._images is None else self._images.refused())),
            sensors={name: track.status() for name, track in self._intake.tracks.items()},
        )
        if self._archive is not None:
            status.archive = self._archive.status()
            status.archive.ack = self._intake.acks.latencies.percentiles()
        if self._images is not None:
            self._images.fill(status)
        return status

    def report(self) -> bytes:
        """Return the encoded status; requests within a short time share it."""
        now_s = time.monotonic()
        if now_s - self._report[0] > _REPORT_S:
            self._report = now_s, self.status().encode()
        return self._report[1]


def _memory_bytes() -> int:
    try:
        with open("/proc/self/statm", "rb") as file:  # noqa: PTH123  a second, ten thousand times
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0


class EventReporter:
    """Reporter of changes as events, to the functions of `CentralNode`."""

    def __init__(
        self, on_event: Callable[[dict[str, Any]], None], on_stored: Callable[[str, int, int, int], None] | None = None
    ) -> None:
        self._on_event, self._on_stored = on_event, on_stored
        self._fault = self._note = ""
        self._refused: Counter[str] = Counter()
        self._next_internal_s = 0.0

    def notify(self, event: str, **reported: Any) -> None:
        """Report an event."""
        with suppress(OSError):  # The listener may be gone; measurements are received all the same.
            self._on_event({"event": event} | reported)

    def stored(self, items: list[ReceivedItem]) -> None:
        """Report measurements that are on disk."""
        if self._on_stored is not None:
            with suppress(OSError):  # The listener may be gone.
                for item in items:
                    self._on_stored(item.run.sensor, item.run.session_id, item.first, getattr(item.content, "crc32", 0))

    def sealed(self, sealed: SealingResult) -> None:
        """Report a journal that has become a recording."""
        self.notify(
            "sealed",
            recording=None if sealed.recording is None else str(sealed.recording),
            measurements=sealed.measurements,
            missing=sealed.missing,
            text=sealed.remark,
        )

    def internal(self, error: Exception) -> None:
        """Report an internal error, at most once per interval."""
        now_s = time.monotonic()
        if now_s >= self._next_internal_s:
            self._next_internal_s = now_s + _LOG_INTERVAL_S
            self.notify("internal", text=text_of(error))

    def fault(self, text: str) -> None:
        """Report a new reason why nothing can be stored; ``text`` is empty once storing works again."""
        before, self._fault = self._fault, text
        if text and text != before:
            self.notify("fault", text=text)
        elif before and not text:
            self.notify("resumed")

    def keys(self, note: str) -> None:
        """Report a new error of the allow list; ``note`` is empty once the list can be used again."""
        if note != self._note:
            self._note = note
            self.notify("keys", text=note or "the allow list can be used again")

    def refused(self, counts: Counter[str]) -> None:
        """Report new refusals."""
        now = counts.copy()
        for reason, count in (now - self._refused).items():
            self.notify("refused", reason=reason, count=count)
        self._refused = now


def text_of(error: Exception) -> str:
    """Return an error as one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
