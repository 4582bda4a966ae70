"""Reflectors: points, spheres, walls and boxes."""

import math
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings.limits import Limits
from ertis_numba.simulation.trajectory import Facing, Placed, direction

__all__ = ["Box", "Point", "Sphere", "Wall"]

_LOUDEST_DB: Final = 120.0  # far beyond any overload; the limit catches amplitudes given instead of levels
_REFLECTION_DB: Final = Limits(-300.0, 0.0)
_Side = Annotated[float, Limits(1e-3, 1e5)]
_Edge = Annotated[float, Limits(1e-3, 1e4)]


class Point(Placed, frozen=True, kw_only=True):
    """Reflector much smaller than its distance, or a flat disc with an orientation.

    Attributes
    ----------
    strength_db : float
        Target strength: level of the echo at 1 m if the call arrives with level 0, in decibels; −20 by default.
    diameter_m : float
        Diameter of a flat disc in metres. Its echo is strongest if it faces both ends of the path. 0, the default, is a
        point that reflects equally in all directions.
    facing_deg : (azimuth, elevation), optional
        Direction of a disc's normal in the world frame, in degrees; towards the origin of the world by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Point
    >>> Point(azimuth_deg=90.0, range_m=2.0).position_at(0.0).round(6).tolist()
    [0.0, 2.0, 0.0]
    """

    strength_db: Annotated[float, Limits(-300.0, _LOUDEST_DB)] = -20.0
    diameter_m: Annotated[float, Limits(0.0, 10.0)] = 0.0
    facing_deg: Facing | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.facing_deg is not None and not self.diameter_m:
            raise ArgumentError(
                "point.facing_deg is given, but a point without a diameter reflects equally in all directions; "
                "add point.diameter_m for a disc, or remove facing_deg"
            )

    def normal_at(self, time_s: float) -> NDArray[np.float64]:
        """Return the unit normal of a disc at a time of the scene: (axis,) float64."""
        return direction(*self.facing_deg) if self.facing_deg is not None else self.towards_origin(time_s)


class Sphere(Placed, frozen=True, kw_only=True):
    """Smooth rigid sphere.

    Attributes
    ----------
    radius_m : float
        Radius in metres.
    reflection_db : float
        Level of the reflected sound relative to the incident sound, in decibels, at most 0; 0 by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Sphere
    >>> Sphere(radius_m=0.1, range_m=1.5).reflection_db
    0.0
    """

    radius_m: Annotated[float, Limits(1e-3, 1e3)]
    reflection_db: Annotated[float, _REFLECTION_DB] = 0.0


class Wall(Placed, frozen=True, kw_only=True):
    """Smooth plane that reflects sound on both sides.

    Attributes
    ----------
    facing_deg : (azimuth, elevation)
        Direction of the normal in the world frame, in degrees.
    size_m : (width, height), optional
        Size in metres, centred at its position; unbounded by default. The width is horizontal. For a floor it is
        perpendicular to the azimuth of ``facing_deg``.
    reflection_db : float
        Level of the reflected sound relative to the incident sound, in decibels, at most 0; 0 by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Wall
    >>> Wall(position_m=(3.0, 0.0, 0.0), facing_deg=(180.0, 0.0)).axes()[0].round(6).tolist()
    [-1.0, 0.0, 0.0]
    """

    facing_deg: Facing
    size_m: tuple[_Side, _Side] | None = None
    reflection_db: Annotated[float, _REFLECTION_DB] = 0.0

    def axes(self) -> NDArray[np.float64]:
        """Return the unit vectors of normal, width and height: (3, axis) float64."""
        azimuth_rad = math.radians(self.facing_deg[0])
        normal = direction(*self.facing_deg)
        width = np.array([-math.sin(azimuth_rad), math.cos(azimuth_rad), 0.0])
        return np.stack([normal, width, np.cross(normal, width)])


class Box(Placed, frozen=True, kw_only=True):
    """Upright box of six walls; a room if the sensors are inside.

    Attributes
    ----------
    size_m : (x, y, z)
        Lengths of the edges before rotation, in metres.
    yaw_deg : float
        Rotation about the vertical axis in degrees; 0 by default.
    reflection_db : float
        Level of the reflected sound relative to the incident sound, in decibels, at most 0; 0 by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Box
    >>> len(Box(position_m=(0.0, 0.0, 0.0), size_m=(4.0, 3.0, 2.5)).walls())
    6
    """

    size_m: tuple[_Edge, _Edge, _Edge]
    yaw_deg: Annotated[float, Limits(-180.0, 180.0)] = 0.0
    reflection_db: Annotated[float, _REFLECTION_DB] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.waypoints:
            raise ArgumentError(
                "box has waypoints, but boxes support only position_m and velocity_m_s; use one of these"
            )

    def walls(self) -> tuple[Wall, ...]:
        """Return the sides of the box, facing outwards: front, back, left, right, top, bottom."""
        yaw_rad = math.radians(self.yaw_deg)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        length, width, height = self.size_m
        sides = (
            ((length / 2, 0.0, 0.0), 0.0, 0.0, (width, height)),
            ((-length / 2, 0.0, 0.0), 180.0, 0.0, (width, height)),
            ((0.0, width / 2, 0.0), 90.0, 0.0, (length, height)),
            ((0.0, -width / 2, 0.0), -90.0, 0.0, (length, height)),
            ((0.0, 0.0, height / 2), 0.0, 90.0, (width, length)),
            ((0.0, 0.0, -height / 2), 0.0, -90.0, (width, length)),
        )
        centre_m = self.position_at(0.0)
        walls = []
        for (x, y, z), azimuth_deg, elevation_deg, size_m in sides:
            offset_m = np.array([cos * x - sin * y, sin * x + cos * y, z])
            place = centre_m + offset_m
            walls.append(
                Wall(
                    position_m=(float(place[0]), float(place[1]), float(place[2])),
                    velocity_m_s=self.velocity_m_s,
                    facing_deg=(_wrapped_deg(azimuth_deg + self.yaw_deg), elevation_deg),
                    size_m=size_m,
                    reflection_db=self.reflection_db,
                )
            )
        return tuple(walls)


def _wrapped_deg(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0
