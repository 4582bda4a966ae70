"""Events of a running central node, each reported once."""

import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

from ertis_numba.journal import SealingResult
from ertis_numba.network.central_node._received_items import ReceivedItem

__all__ = ["EventReporter", "text_of"]

_LOG_INTERVAL_S: Final = 1.0  # Interval between events about internal errors.


class EventReporter:
    """Reporter of changes as events.

    Parameters
    ----------
    on_event : callable
        Called with each event.
    on_stored : callable, optional
        Called with sensor, session_id, sequence and CRC-32 of stored measurements.
    """

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
