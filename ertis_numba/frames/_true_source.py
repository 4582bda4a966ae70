"""Sources of sound: a part of the ground truth of a simulation."""

from dataclasses import dataclass

from ertis_numba.base.angles import RadiansFromDegrees

__all__ = ["TrueSource"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueSource(RadiansFromDegrees):
    """Ground truth of one source of sound during a simulated measurement.

    The properties ``azimuth_rad`` and ``elevation_rad`` are the angles in radians.

    Attributes
    ----------
    name : str
        Name of the source in the scene, such as ``noises[0]``.
    kind : str
        ``tone``, ``noise`` or ``sonar``.
    position_m : (x, y, z)
        Position in the world frame at the start of the measurement, in metres.
    azimuth_deg, elevation_deg : float
        Direction of this position in the sensor frame, in degrees.
    range_m : float
        Distance of the source from the sensor's origin, in metres.
    band_hz : (low, high)
        Lowest and highest frequency of the sound, in hertz.
    level_dbfs : float
        RMS of the sound at the microphones, averaged over their powers, in dBFS; that of calls while they last. Sound
        over walls is included. −300 if nothing arrives.

    Examples
    --------
    >>> from ertis_numba.frames import TrueSource
    >>> source = TrueSource(
    ...     name="noises[0]",
    ...     kind="noise",
    ...     position_m=(0.0, 2.0, 0.0),
    ...     azimuth_deg=90.0,
    ...     elevation_deg=0.0,
    ...     range_m=2.0,
    ...     band_hz=(20e3, 80e3),
    ...     level_dbfs=-66.0,
    ... )
    >>> round(source.azimuth_rad, 4)
    1.5708
    """

    name: str
    kind: str
    position_m: tuple[float, float, float]
    azimuth_deg: float
    elevation_deg: float
    range_m: float
    band_hz: tuple[float, float]
    level_dbfs: float
