"""From sensors to the journal: what a capture does between the driver and the file."""

from ertis_numba.capture.session import CaptureCounts, Session

__all__ = ["CaptureCounts", "Session"]
