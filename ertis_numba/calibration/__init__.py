"""Calibration of arrays: gains, delays, polarities and positions of microphones, and poses of sensors.

Functions share these shapes: source_m (record, axis), positions_m (mic, axis), delay_s and used (mic,),
speed_m_s (record,), time_s and time_sd_s (record, mic).
"""

from ertis_numba.calibration.array_calibration import calibrate
from ertis_numba.calibration.result import Calibration, Residuals
from ertis_numba.calibration.usable_sounds import OtherLayoutError
from ertis_numba.calibration.wavefronts import Target

__all__ = ["Calibration", "OtherLayoutError", "Residuals", "Target", "calibrate"]
