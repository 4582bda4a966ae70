"""Destination and counts of the measurements of a capture session."""

import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from ertis_numba.journal import JournalEntry
from ertis_numba.settings import Settings

__all__ = ["CaptureCounts", "MeasurementSink"]


class MeasurementSink(Protocol):
    """Destination of measurements: a `Journal`, or a buffer that keeps them until another node has stored them."""

    def add_sensor(
        self,
        name: str,
        settings: Settings,
        *,
        firmware: str = "",
        translation_m: Sequence[float] | None = ...,
        rotation_xyzw: Sequence[float] | None = ...,
    ) -> None:
        """Register a sensor before its first measurement; a `Journal` refuses later changes of settings."""

    def append(self, entries: Sequence[JournalEntry]) -> Sequence[JournalEntry] | None:
        """Store measurements, and return those that were stored, or None for all."""

    def note_gap(self, sensor: str, first: int, last: int, reason: str, *, session_id: int) -> None:
        """Store why numbers of a sensor are missing, ``first`` and ``last`` included."""


_RECENT_S = 3.0  # Interval of the reported rate.


@dataclass(slots=True)
class CaptureCounts:
    """Counts of one sensor's measurements."""

    stored: int = 0
    missing: Counter[str] = field(default_factory=Counter)  # by reason
    unplugged: int = 0
    skipped: int = 0  # commands, because the sensor was still busy
    times_s: deque[float] = field(default_factory=lambda: deque(maxlen=64))
    """Times of the latest stored measurements by `time.monotonic`, in seconds."""

    @property
    def lost(self) -> int:
        """Number of all missing measurements."""
        return sum(self.missing.values())

    @property
    def rate_hz(self) -> float:
        """Recent rate of stored measurements, in Hz."""
        now_s = time.monotonic()
        recent_s = [time_s for time_s in self.times_s if now_s - time_s < _RECENT_S]
        return (len(recent_s) - 1) / max(recent_s[-1] - recent_s[0], 1e-9) if len(recent_s) > 1 else 0.0
