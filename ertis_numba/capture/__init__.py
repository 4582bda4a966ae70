"""Capture of measurements from sensors into a journal."""

from ertis_numba.capture.counts import CaptureCounts
from ertis_numba.capture.session import CaptureSession, SettingsChange
from ertis_numba.capture.sink import MeasurementSink

__all__ = ["CaptureCounts", "CaptureSession", "MeasurementSink", "SettingsChange"]
