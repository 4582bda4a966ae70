"""What is taken from a source, and what is drawn of it."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Energyscape, PointCloud, Stamp
from ertis_numba.settings import Settings

__all__ = ["UNTURNED", "Dome", "Drawn", "Frame", "Pose", "Sector", "Taken"]


@dataclass(frozen=True, slots=True)
class Pose:
    """Where a sensor is on its platform.

    Attributes
    ----------
    translation_m : (x, y, z)
    rotation_xyzw : (x, y, z, w)
        The unit quaternion that turns the sensor frame into the platform's.
    """

    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    def placed(self, position_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return places of the sensor's frame in that of the platform: (point, axis) float32."""
        energy = np.ones(len(position_m), np.float32)
        cloud = PointCloud(position_m, energy, Settings(), Stamp(), self.translation_m, self.rotation_xyzw)
        return cloud.on_platform_m()


UNTURNED: Final = Pose()
"""Of a sensor of which nobody said where it is."""


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """An image to show.

    Attributes
    ----------
    image : Energyscape
    pose : Pose
    time_s : float
        When it was, by the clock that points fade by.
    """

    image: Energyscape
    pose: Pose
    time_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Sector:
    """A planar image in the horizontal plane of its sensor.

    Attributes
    ----------
    colours : (row, column, 4) uint8
        The first row is farthest ahead, the first column farthest to the left.
    extent_m : (right, right, ahead, ahead)
        Where it begins and ends to the right of the sensor and ahead of it.
    """

    colours: NDArray[np.uint8]
    extent_m: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Dome:
    """The strongest over range of each direction, on a sphere around the sensor.

    Attributes
    ----------
    position_m : (direction, axis) float32
        Sensor frame.
    colours : (direction, 3) uint8
    size_m : float
        Of each point, such that they touch.
    """

    position_m: NDArray[np.float32]
    colours: NDArray[np.uint8]
    size_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """What to draw of a sensor.

    Attributes
    ----------
    pose : Pose
    sequence : int
    timestamp_ns : int
    picture : (row, column, 3) uint8
        Range and azimuth, with axes.
    shape : Sector or Dome, optional
        None where the image is part of one of several sensors.
    position_m : (point, axis) float32
        On the platform.
    colours : (point, 3) uint8
        Of the points, by their levels; darker with age.
    n_points : int
        How many of them are of the latest image.
    """

    pose: Pose
    sequence: int
    timestamp_ns: int
    picture: NDArray[np.uint8]
    shape: Sector | Dome | None
    position_m: NDArray[np.float32]
    colours: NDArray[np.uint8]
    n_points: int


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What to draw of all sensors.

    Attributes
    ----------
    sensors : dict of str to Drawn
        By their names.
    range_m : float
        How far is seen.
    fused : Sector, optional
        What several sensors that are level see, on the platform; None where there are no several, or one is tilted or
        has elevations.
    height_m : float
        Of the fused image on the platform.
    """

    sensors: dict[str, Drawn]
    range_m: float
    fused: Sector | None = None
    height_m: float = 0.0

    @property
    def centre_m(self) -> tuple[float, float, float]:
        """The middle, on the platform, of what the sensors see."""
        ahead_m = np.array([[self.range_m / 2, 0, 0]], np.float32)
        middles_m = [drawn.pose.placed(ahead_m)[0] for drawn in self.sensors.values()]
        x, y, z = np.mean(middles_m, axis=0).tolist() if middles_m else (0.0, 0.0, 0.0)
        return x, y, z
