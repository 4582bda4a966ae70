"""Capture of measurements from sensors into a journal."""

from ertis_numba.devices.capture.session import CaptureSession, SettingsChange
from ertis_numba.devices.capture.sink import CaptureCounts, MeasurementSink

__all__ = ["CaptureCounts", "CaptureSession", "MeasurementSink", "SettingsChange"]
