"""Position and motion of the objects of a scene."""

import itertools
import math
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import unit_vectors
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import Limits

__all__ = [
    "MAX_SPEED_M_S",
    "Coordinate",
    "Facing",
    "Instant",
    "Placed",
    "Position",
    "Velocity",
    "direction",
]

_MAX_DISTANCE_M: Final = 1e4
MAX_SPEED_M_S: Final = 100.0  # a third of the speed of sound; beyond, air flow around the object would matter

Coordinate = Annotated[float, Limits(-_MAX_DISTANCE_M, _MAX_DISTANCE_M)]
Position = tuple[Coordinate, Coordinate, Coordinate]
_Speed = Annotated[float, Limits(-MAX_SPEED_M_S, MAX_SPEED_M_S)]
Velocity = tuple[_Speed, _Speed, _Speed]
Instant = Annotated[float, Limits(-math.inf, math.inf, "{} time")]
Facing = tuple[
    Annotated[float, Limits(-180.0, 180.0, "{} azimuth")], Annotated[float, Limits(-90.0, 90.0, "{} elevation")]
]
"""Azimuth and elevation of an axis in the world frame, in degrees."""
_STILL: Velocity = (0.0, 0.0, 0.0)


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

    position_m: Position | None = None
    azimuth_deg: Annotated[float, Limits(-180.0, 180.0)] | None = None
    elevation_deg: Annotated[float, Limits(-90.0, 90.0)] | None = None
    range_m: Annotated[float, Limits(1e-3, _MAX_DISTANCE_M)] | None = None
    velocity_m_s: Velocity = _STILL
    waypoints: tuple[tuple[Instant, Coordinate, Coordinate, Coordinate], ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        name = self.label()
        polar = [value for value in (self.azimuth_deg, self.elevation_deg, self.range_m) if value is not None]
        if (self.position_m is not None) + bool(polar) + bool(self.waypoints) != 1:
            raise ArgumentError(
                f"{name} does not have exactly one position; choose one of position_m, range_m with azimuth_deg and "
                "elevation_deg, or waypoints"
            )
        if polar and self.range_m is None:
            raise ArgumentError(f"{name} has a direction but no range_m; add range_m")
        if self.waypoints and self.velocity_m_s != _STILL:
            raise ArgumentError(f"{name} has both waypoints and velocity_m_s; use only one of them")
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


def direction(azimuth_deg: float, elevation_deg: float) -> NDArray[np.float64]:
    """Return the unit vector of a direction in the world frame: (axis,) float64."""
    azimuth_rad, elevation_rad = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation_rad)
    return np.array([level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), math.sin(elevation_rad)])
