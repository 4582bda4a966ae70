"""Sound events: a source in a band, for as long as it is heard; and the true source of a simulation."""

from dataclasses import dataclass

from ertis_numba.base.angles import RadiansFromDegrees

__all__ = ["SoundEvent", "TrueSource"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SoundEvent(RadiansFromDegrees):
    """Source of sound in a band, from its onset to its last bearing.

    The properties ``azimuth_rad`` and ``elevation_rad`` are the angles in radians.

    Attributes
    ----------
    number : int
        Number of the event, from 1.
    band_hz : (low, high)
        Edges of the band in hertz.
    start_s, end_s : float
        Times of the first and of the last bearing in seconds.
    azimuth_deg, elevation_deg : float
        Direction at ``end_s`` in the sensor frame in degrees.
    sideways_deg, upwards_deg : float
        Standard deviations of the direction along the sphere in degrees.
    sideways_deg_s, upwards_deg_s : float
        Velocity of the direction along the sphere in degrees per second.
    level_dbfs : float
        Largest level of its bearings in dBFS.
    n_bearings : int
        Number of bearings.
    is_over : bool
        True if the source is no longer heard.

    Examples
    --------
    >>> from ertis_numba.frames import SoundEvent
    >>> SoundEvent(number=1, band_hz=(30e3, 40e3), start_s=2.0, end_s=2.5, azimuth_deg=10.0, elevation_deg=0.0,
    ...            sideways_deg=0.1, upwards_deg=0.1, sideways_deg_s=0.0, upwards_deg_s=0.0, level_dbfs=-60.0,
    ...            n_bearings=6, is_over=True).duration_s
    0.5
    """

    number: int
    band_hz: tuple[float, float]
    start_s: float
    end_s: float
    azimuth_deg: float
    elevation_deg: float
    sideways_deg: float
    upwards_deg: float
    sideways_deg_s: float
    upwards_deg_s: float
    level_dbfs: float
    n_bearings: int
    is_over: bool

    @property
    def duration_s(self) -> float:
        """Time from the first to the last bearing in seconds."""
        return self.end_s - self.start_s


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
