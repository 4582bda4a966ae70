"""What returns the sound: points, spheres, walls and boxes."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.errors import ArgumentError
from ertis_numba.simulation.placed import Placed

__all__ = ["Box", "Point", "Sphere", "Wall"]

_LOUDEST_DB = 120.0  # far beyond any overload; the bound catches amplitudes given for levels


class Point(Placed, frozen=True, kw_only=True):
    """A reflector much smaller than its distance, or a flat round one that faces somewhere.

    Attributes
    ----------
    strength_db : float
        Target strength: level of its echo 1 m from it when the call reaches it with level 0.
    diameter_m : float
        Of a flat disc, whose echo is the stronger the better it faces both ends of the path. 0, the default, is a
        point that returns the sound alike in all directions.
    facing_deg : (azimuth, elevation), optional
        Where a disc faces, in the world frame; towards the origin of the world by default.
    """

    strength_db: float = -20.0
    diameter_m: float = 0.0
    facing_deg: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("point.strength_db", self.strength_db, -300.0, _LOUDEST_DB)
        checks.between("point.diameter_m", self.diameter_m, 0.0, 10.0)
        if self.facing_deg is not None:
            checks.between("point.facing_deg azimuth", self.facing_deg[0], -180.0, 180.0)
            checks.between("point.facing_deg elevation", self.facing_deg[1], -90.0, 90.0)
            if not self.diameter_m:
                raise ArgumentError(
                    "point.facing_deg is given, but a point without a diameter reflects equally in all directions; "
                    "give point.diameter_m for a disc, or leave facing_deg out"
                )

    def normal_at(self, time_s: float) -> NDArray[np.float64]:
        """Return the unit vector in which a disc faces: (axis,) float64."""
        if self.facing_deg is not None:
            return _direction(*self.facing_deg)
        place = -self.position_at(time_s)
        length = float(np.linalg.norm(place))
        return place / length if length else np.array([1.0, 0.0, 0.0])


class Sphere(Placed, frozen=True, kw_only=True):
    """A smooth hard sphere, much larger than a wavelength.

    Attributes
    ----------
    radius_m : float
        Radius of the sphere.
    reflection_db : float
        Level of what it reflects below what reaches it.
    """

    radius_m: float
    reflection_db: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("sphere.radius_m", self.radius_m, 1e-3, 1e3)
        checks.between("sphere.reflection_db", self.reflection_db, -300.0, 0.0)


class Wall(Placed, frozen=True, kw_only=True):
    """A smooth plane that mirrors the sound on both sides.

    Attributes
    ----------
    facing_deg : (azimuth, elevation)
        Its normal.
    size_m : (width, height), optional
        Around its position; without end by default. The width is horizontal; of a floor it lies across
        the azimuth that ``facing_deg`` names.
    reflection_db : float
        Level of the reflected sound relative to the incident sound.
    """

    facing_deg: tuple[float, float]
    size_m: tuple[float, float] | None = None
    reflection_db: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("wall.facing_deg azimuth", self.facing_deg[0], -180.0, 180.0)
        checks.between("wall.facing_deg elevation", self.facing_deg[1], -90.0, 90.0)
        for side_m in self.size_m or ():
            checks.between("wall.size_m", side_m, 1e-3, 1e5)
        checks.between("wall.reflection_db", self.reflection_db, -300.0, 0.0)

    def axes(self) -> NDArray[np.float64]:
        """Return normal, width and height as unit vectors: (3, axis) float64."""
        azimuth_rad = math.radians(self.facing_deg[0])
        normal = _direction(*self.facing_deg)
        width = np.array([-math.sin(azimuth_rad), math.cos(azimuth_rad), 0.0])
        return np.stack([normal, width, np.cross(normal, width)])


class Box(Placed, frozen=True, kw_only=True):
    """A box of six walls, standing upright; a room, if the sensors are in it.

    Attributes
    ----------
    size_m : (x, y, z)
        Lengths of the edges before the turn.
    yaw_deg : float
        Turn about the vertical axis.
    reflection_db : float
        Level of the reflected sound relative to the incident sound.
    """

    size_m: tuple[float, float, float]
    yaw_deg: float = 0.0
    reflection_db: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for side_m in self.size_m:
            checks.between("box.size_m", side_m, 1e-3, 1e4)
        checks.between("box.yaw_deg", self.yaw_deg, -180.0, 180.0)
        checks.between("box.reflection_db", self.reflection_db, -300.0, 0.0)
        if self.waypoints:
            raise ArgumentError("box has waypoints; give position_m and velocity_m_s")

    def walls(self) -> tuple[Wall, ...]:
        """Return its sides, facing outwards: front, back, left, right, top, bottom."""
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


def _direction(azimuth_deg: float, elevation_deg: float) -> NDArray[np.float64]:
    azimuth_rad, elevation_rad = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation_rad)
    return np.array([level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), math.sin(elevation_rad)])


def _wrapped_deg(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0
