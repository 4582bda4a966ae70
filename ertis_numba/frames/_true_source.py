"""Sources of sound: a part of the ground truth of a simulation."""

from dataclasses import dataclass

from ertis_numba.base.angles import RadiansFromDegrees

__all__ = ["TrueSource"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueSource(RadiansFromDegrees):
    """Ground truth of one source of sound during a simulated measurement."""

    name: str  # in the scene, such as noises[0]
    kind: str  # tone, noise or sonar
    position_m: tuple[float, float, float]  # in the world at the start of the measurement
    azimuth_deg: float  # in the sensor frame
    elevation_deg: float  # in the sensor frame
    range_m: float  # from the sensor's origin
    band_hz: tuple[float, float]  # lowest and highest frequency
    level_dbfs: float  # RMS over the microphones, of calls while they last, with sound over walls; −300: none
