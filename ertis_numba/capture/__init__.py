"""Capture of measurements from sensors into a journal."""

from ertis_numba.capture.session import CaptureCounts, Session

__all__ = ["CaptureCounts", "Session"]
