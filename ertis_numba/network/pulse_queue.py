"""Queue of pulses between the receiver of a central node's images and a slow application."""

import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, Generic, TypeVar

__all__ = ["MAX_KEPT_BYTES", "MAX_WAITING", "PulseQueue"]

MAX_WAITING: Final = 2
"""Limit on waiting pulses; a slow application gets the latest ones."""
MAX_KEPT_BYTES: Final = 64_000_000
"""Limit on the images that wait while pulses are kept."""
_CATCHING_UP: Final = 2.0  # Longest time until all that waited is used, relative to the time in which it arrived.

Pulse = TypeVar("Pulse")


class PulseQueue(Generic[Pulse]):
    """Queue that keeps the latest pulses, or all of them while the application prepares; thread-safe."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[tuple[Pulse, int]] = deque()
        self._kept_until_s = -math.inf
        self._failure: Exception | None = None
        self._closed = self._ended = False
        self.n_skipped = 0

    def put(self, pulse: Pulse, n_bytes: int) -> None:
        """Add a pulse whose images have a size, and discard the earliest ones beyond the limits."""
        with self._changed:
            self._waiting.append((pulse, n_bytes))
            while len(self._waiting) > MAX_WAITING and not self._are_kept():
                self._waiting.popleft()
                self.n_skipped += 1
            self._changed.notify_all()

    def take(self, timeout_s: float | None = None) -> Pulse | None:
        """Return the next pulse; None after ``timeout_s``, once the queue is closed, or after the last one."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._failure or self._closed or self._ended, timeout_s)
            if self._failure is not None:
                raise self._failure
            if self._closed or not self._waiting:
                return None
            pulse, _ = self._waiting.popleft()
            if not self._waiting:
                self._kept_until_s = -math.inf
            return pulse

    @property
    def is_empty(self) -> bool:
        """True if no pulse waits."""
        return not self._waiting

    def fail(self, failure: Exception) -> None:
        """Raise an exception in calls of `take`."""
        with self._changed:
            self._failure = failure
            self._changed.notify_all()

    def end(self) -> None:
        """Add no more pulses; `take` returns those that wait, and then None."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def close(self) -> None:
        """End waiting calls of `take`."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @contextmanager
    def keeping(self) -> Iterator[None]:
        """Keep all pulses, up to 64 MB of images, during the block and for up to twice its time afterwards."""
        begun_s = time.monotonic()
        self._kept_until_s = math.inf
        try:
            yield
        finally:
            end_s = time.monotonic()
            self._kept_until_s = end_s + _CATCHING_UP * (end_s - begun_s)

    def _are_kept(self) -> bool:
        return time.monotonic() < self._kept_until_s and sum(size for _, size in self._waiting) <= MAX_KEPT_BYTES
