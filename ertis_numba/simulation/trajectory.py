"""Position and motion of the objects of a scene."""

import itertools
import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import unit_vectors
from ertis_numba.settings.documents import TomlTable

__all__ = ["MAX_DISTANCE_M", "MAX_SPEED_M_S", "Placed", "Vector", "check_vector", "direction"]

Vector = tuple[float, float, float]
MAX_DISTANCE_M: Final = 1e4
MAX_SPEED_M_S: Final = 100.0  # a third of the speed of sound; beyond, air flow around the object would matter
_STILL: Vector = (0.0, 0.0, 0.0)


class Placed(TomlTable, frozen=True, kw_only=True):
    """Object with a position in the world frame: x forward, y left, z up.

    Attributes
    ----------
    position_m : (x, y, z), optional
        Position at the start of the first measurement, in metres.
    azimuth_deg, elevation_deg, range_m : float, optional
        The same position in spherical coordinates about the origin; use either these or ``position_m``.
    velocity_m_s : (x, y, z)
        Constant velocity in the world frame, in metres per second; 0 by default.
    waypoints : tuple of (time_s, x, y, z)
        Times in seconds and positions in metres, instead of all of the above. The object moves on straight lines
        between them, and rests before the first and after the last; none by default.
    """

    position_m: Vector | None = None
    azimuth_deg: float | None = None
    elevation_deg: float | None = None
    range_m: float | None = None
    velocity_m_s: Vector = _STILL
    waypoints: tuple[tuple[float, float, float, float], ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        name = self.label()
        polar = [value for value in (self.azimuth_deg, self.elevation_deg, self.range_m) if value is not None]
        if (self.position_m is not None) + bool(polar) + bool(self.waypoints) != 1:
            raise ArgumentError(
                f"{name} does not have exactly one position; choose one of position_m, range_m with azimuth_deg and "
                "elevation_deg, or waypoints"
            )
        if polar:
            if self.range_m is None:
                raise ArgumentError(f"{name} has a direction but no range_m; add range_m")
            checks.between(f"{name}.range_m", self.range_m, 1e-3, MAX_DISTANCE_M)
            checks.between(f"{name}.azimuth_deg", self.azimuth_deg or 0.0, -180.0, 180.0)
            checks.between(f"{name}.elevation_deg", self.elevation_deg or 0.0, -90.0, 90.0)
        if self.position_m is not None:
            check_vector(f"{name}.position_m", self.position_m, MAX_DISTANCE_M)
        check_vector(f"{name}.velocity_m_s", self.velocity_m_s, MAX_SPEED_M_S)
        if self.waypoints and self.velocity_m_s != _STILL:
            raise ArgumentError(f"{name} has both waypoints and velocity_m_s; use only one of them")
        for number, (time_s, *place) in enumerate(self.waypoints):
            checks.finite(f"{name}.waypoints[{number}] time", time_s)
            check_vector(f"{name}.waypoints[{number}]", (place[0], place[1], place[2]), MAX_DISTANCE_M)
        for (before_s, *a), (after_s, *b) in itertools.pairwise(self.waypoints):
            if after_s <= before_s:
                raise ArgumentError(
                    f"{name}.waypoints go from {before_s:g} s to {after_s:g} s; pass strictly increasing times"
                )
            checks.between(f"{name}.waypoints speed", math.dist(a, b) / (after_s - before_s), 0.0, MAX_SPEED_M_S)

    @property
    def moves(self) -> bool:
        """True if the object ever changes its position."""
        return self.velocity_m_s != _STILL or len(self.waypoints) > 1

    def position_at(self, time_s: float) -> NDArray[np.float64]:
        """Return the position at a time of the scene: (axis,) float64."""
        if self.waypoints:
            times, *axes = np.array(self.waypoints).T
            return np.array([np.interp(time_s, times, axis) for axis in axes])
        return self._start_m() + time_s * np.array(self.velocity_m_s)

    def velocity_at(self, time_s: float) -> NDArray[np.float64]:
        """Return the velocity at a time of the scene: (axis,) float64."""
        for (before_s, *a), (after_s, *b) in itertools.pairwise(self.waypoints):
            if before_s <= time_s < after_s:
                return np.asarray((np.array(b) - np.array(a)) / (after_s - before_s))
        return np.array(_STILL if self.waypoints else self.velocity_m_s)

    def towards_origin(self, time_s: float) -> NDArray[np.float64]:
        """Return the unit vector towards the origin of the world at a time of the scene: (axis,) float64."""
        place = -self.position_at(time_s)
        length = float(np.linalg.norm(place))
        return place / length if length else np.array([1.0, 0.0, 0.0])

    def _start_m(self) -> NDArray[np.float64]:
        if self.position_m is not None:
            return np.array(self.position_m)
        azimuth_rad, elevation_rad = math.radians(self.azimuth_deg or 0.0), math.radians(self.elevation_deg or 0.0)
        return np.asarray((self.range_m or 0.0) * unit_vectors(np.array(azimuth_rad), np.array(elevation_rad)))


def check_vector(name: str, vector: Vector, largest: float) -> None:
    """Raise an error for a vector with a component beyond ±``largest``."""
    for part in vector:
        checks.between(name, part, -largest, largest)


def direction(azimuth_deg: float, elevation_deg: float) -> NDArray[np.float64]:
    """Return the unit vector of a direction in the world frame: (axis,) float64."""
    azimuth_rad, elevation_rad = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation_rad)
    return np.array([level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), math.sin(elevation_rad)])
