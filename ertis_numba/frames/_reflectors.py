"""Reflectors: the ground truth of a simulation, and the peaks that an image shows."""

import math
from dataclasses import dataclass, field

from ertis_numba.base.angles import RadiansFromDegrees

__all__ = ["Peak", "Reflector"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflector(RadiansFromDegrees):
    """Ground truth of one echo of a simulated measurement.

    The properties ``azimuth_rad`` and ``elevation_rad`` are the angles in radians.

    Attributes
    ----------
    name : str
        Name of the reflector in the scene, such as ``points[2]``, or the walls of a reflection path.
    azimuth_deg, elevation_deg : float
        Direction in the sensor frame at the start of the emission, in degrees.
    range_m : float
        Range in the sensor frame at the start of the emission, in metres.
    level_db : float
        Level of the echo in dB, relative to the strongest echo of the sensor's own call. It is at most 0, except for
        echoes of other emitters.
    velocity_m_s : (x, y, z), default (0, 0, 0)
        Velocity relative to the sensor, in the sensor frame, in metres per second.
    emitter : str, default ""
        Name of another sensor, if the echo is that of its call. Images show such echoes at places without reflectors.

    Examples
    --------
    >>> from ertis_numba import Reflector
    >>> round(Reflector(name="post", azimuth_deg=30.0, elevation_deg=0.0, range_m=1.2, level_db=0.0).azimuth_rad, 4)
    0.5236
    """

    name: str
    azimuth_deg: float
    elevation_deg: float
    range_m: float
    level_db: float
    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emitter: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Peak(RadiansFromDegrees):
    """Reflector detected in an energyscape.

    The properties ``azimuth_rad`` and ``elevation_rad`` are the angles in radians.

    Attributes
    ----------
    azimuth_deg, elevation_deg : float
        Interpolated direction in degrees; NaN for an angle that the array cannot observe.
    range_m : float
        Interpolated range in metres.
    level_db : float
        Level in dB relative to the strongest peak of the same energyscape, at most 0.
    level_dbfs : float, default NaN
        Level in dB relative to a full-scale echo in every microphone; NaN if it is unknown.
    grid_error_deg : float, default NaN
        Standard deviation of the direction that the grid causes, in degrees: 0 if the direction is interpolated.
        Otherwise, it is the spacing divided by √12 at most. It is infinite for a single direction, and where the
        reflector may lie beyond the grid, and NaN if it is unknown.
    angle_sd_deg : float, default NaN
        Standard deviation of the direction along its least certain axis in degrees, from noise, plan and grid.
        Infinite where ``grid_error_deg`` is. Like the following ones, NaN if the noise is unknown, or if the image is
        one of the method ``paper``.
    range_sd_m : float, default NaN
        Standard deviation of the range in metres.
    level_sd_db : float, default NaN
        Standard deviation of ``level_dbfs`` in dB.

    Examples
    --------
    >>> from ertis_numba import Peak
    >>> round(Peak(azimuth_deg=-45.0, elevation_deg=0.0, range_m=2.0, level_db=0.0).azimuth_rad, 4)
    -0.7854
    """

    azimuth_deg: float
    elevation_deg: float
    range_m: float
    level_db: float
    level_dbfs: float = field(default=math.nan, compare=False)
    grid_error_deg: float = field(default=math.nan, compare=False)
    angle_sd_deg: float = field(default=math.nan, compare=False)
    range_sd_m: float = field(default=math.nan, compare=False)
    level_sd_db: float = field(default=math.nan, compare=False)
