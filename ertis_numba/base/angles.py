"""Azimuth and elevation in degrees beside radians, and the reverse."""

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["DegreesFromRadians", "RadiansFromDegrees"]


class DegreesFromRadians:
    """Properties in degrees of a class whose arrays of angles are in radians."""

    __slots__ = ()

    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]

    @property
    def azimuth_deg(self) -> NDArray[np.float64]:
        """Azimuth in degrees, of the shape of ``azimuth_rad``."""
        return np.degrees(self.azimuth_rad)

    @property
    def elevation_deg(self) -> NDArray[np.float64]:
        """Elevation in degrees, of the shape of ``elevation_rad``."""
        return np.degrees(self.elevation_rad)


class RadiansFromDegrees:
    """Properties in radians of a class whose angles are in degrees."""

    __slots__ = ()

    azimuth_deg: float
    elevation_deg: float

    @property
    def azimuth_rad(self) -> float:
        """Azimuth in radians."""
        return math.radians(self.azimuth_deg)

    @property
    def elevation_rad(self) -> float:
        """Elevation in radians."""
        return math.radians(self.elevation_deg)
