"""Capture of measurements from sensors into a journal."""

from ertis_numba.capture.session import CaptureCounts, CaptureSession

__all__ = ["CaptureCounts", "CaptureSession"]
