"""Check of a sensor by its recordings: microphones, noise, clock, losses, call and calibration, with a verdict."""

from ertis_numba.sensor_check.clock import ClockCheck
from ertis_numba.sensor_check.examination import check_recording
from ertis_numba.sensor_check.page import write_page
from ertis_numba.sensor_check.residuals import CalibrationResiduals
from ertis_numba.sensor_check.result import CheckFault, CheckItem, RecordingCheck, SensorCheck

__all__ = [
    "CalibrationResiduals",
    "CheckFault",
    "CheckItem",
    "ClockCheck",
    "RecordingCheck",
    "SensorCheck",
    "check_recording",
    "write_page",
]
