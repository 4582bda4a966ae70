"""Calibration of arrays: gains, delays, polarities and positions of microphones, and poses of sensors."""

from ertis_numba.calibration.array_calibration import calibrate
from ertis_numba.calibration.result import Calibration, Residuals
from ertis_numba.calibration.usable_sounds import OtherLayoutError
from ertis_numba.calibration.wavefronts import Target

__all__ = ["Calibration", "OtherLayoutError", "Residuals", "Target", "calibrate"]
