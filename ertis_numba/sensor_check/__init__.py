"""Check of a sensor by its recordings: microphones, noise, clock, losses, call and calibration, with a verdict."""

from ertis_numba.sensor_check.clock import ClockCheck
from ertis_numba.sensor_check.examination import check_recording, uncheckable_recording
from ertis_numba.sensor_check.lost_words import LostWords
from ertis_numba.sensor_check.page import write_page
from ertis_numba.sensor_check.residuals import ArrayFinding, CalibrationResiduals
from ertis_numba.sensor_check.result import CheckFault, CheckItem, RecordingCheck, SensorCheck

__all__ = [
    "ArrayFinding",
    "CalibrationResiduals",
    "CheckFault",
    "CheckItem",
    "ClockCheck",
    "LostWords",
    "RecordingCheck",
    "SensorCheck",
    "check_recording",
    "uncheckable_recording",
    "write_page",
]
