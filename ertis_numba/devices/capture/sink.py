"""Destination of the measurements of a capture session."""

from collections.abc import Sequence
from typing import Protocol

from ertis_numba.journal import JournalEntry
from ertis_numba.settings import Settings

__all__ = ["MeasurementSink"]


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
        """Register a sensor before its first measurement, or again with settings for the following sessions.

        A `Journal` accepts each sensor once, so that changes of settings are refused.
        """

    def append(self, entries: Sequence[JournalEntry]) -> Sequence[JournalEntry] | None:
        """Store measurements; None means that all of them are stored, otherwise return the stored ones."""

    def note_gap(self, sensor: str, first: int, last: int, reason: str, *, session_id: int) -> None:
        """Store why numbers of a sensor are missing, ``first`` and ``last`` included."""
