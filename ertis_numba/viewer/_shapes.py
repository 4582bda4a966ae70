"""Images from a source, and drawn objects."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Generic, Literal, Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import AcousticMap, Energyscape, LevelUnit, PointCloud, Stamp
from ertis_numba.settings import Settings

__all__ = [
    "UNTURNED",
    "BandLevel",
    "Dome",
    "Drawn",
    "DrawnFrame",
    "LevelScale",
    "Pose",
    "ReceivedImage",
    "Sector",
    "Unit",
]

Unit: TypeAlias = LevelUnit | Literal["dB"]
"""Unit of the levels of acoustic maps."""

Shown_co = TypeVar("Shown_co", Energyscape, AcousticMap, covariant=True)

_OVERDUE_S: Final = 1.0  # Lower limit, because images arrive in bursts on a busy network or computer.
_UNKNOWN_S: Final = 10.0  # Time without an image after a single one, whose interval is unknown.
_OVERDUE: Final = 3.0  # Number of intervals without an image after which a sensor is overdue.


_Numbers = Sequence[float] | NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a sensor on its platform.

    Attributes
    ----------
    translation_m : (x, y, z)
    rotation_xyzw : (x, y, z, w)
        Unit quaternion that rotates the sensor frame into the platform frame.
    """

    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    @classmethod
    def of(cls, translation_m: _Numbers | None, rotation_xyzw: _Numbers | None) -> Self | None:
        """Return a pose, or None if the mounting is unknown."""
        if translation_m is None or rotation_xyzw is None:
            return None
        x, y, z = map(float, translation_m)
        i, j, k, w = map(float, rotation_xyzw)
        return cls((x, y, z), (i, j, k, w))

    def placed(self, position_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return points of the sensor frame in the frame of the platform: (point, axis) float32."""
        amplitude = np.ones(len(position_m), np.float32)
        cloud = PointCloud(position_m, amplitude, Settings(), Stamp(), self.translation_m, self.rotation_xyzw)
        return cloud.on_platform_m().astype(np.float32)


UNTURNED: Final = Pose()
"""Pose of a single sensor with unknown mounting."""


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedImage(Generic[Shown_co]):
    """An image or acoustic map to show.

    Attributes
    ----------
    image : Energyscape or AcousticMap
    pose : Pose or None
        None if the mounting is unknown.
    time_s : float
        Time of the image, by the clock of fading points.
    interval_s : float, optional
        Typical interval between images of the sensor, if known.
    """

    image: Shown_co
    pose: Pose | None
    time_s: float
    interval_s: float | None = None

    @property
    def due_s(self) -> float:
        """Time from which the sensor is overdue without another image."""
        silent_s = _UNKNOWN_S if self.interval_s is None else max(_OVERDUE_S, _OVERDUE * self.interval_s)
        return self.time_s + silent_s


@dataclass(frozen=True, slots=True, eq=False)
class Sector:
    """A planar image in the horizontal plane of its sensor.

    Attributes
    ----------
    colours : (row, column, 4) uint8
        The first row is farthest ahead, the first column farthest to the left.
    extent_m : (right, right, ahead, ahead)
        Limits to the right of the sensor and ahead of it, in metres.
    """

    colours: NDArray[np.uint8]
    extent_m: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Dome:
    """Levels of directions on a sphere around the sensor, those of echoes or of an acoustic map.

    Attributes
    ----------
    position_m : (direction, axis) float32
        Sensor frame.
    colours : (direction, 3) uint8
    size_m : float
        Diameter of the points, at which they touch.
    """

    position_m: NDArray[np.float32]
    colours: NDArray[np.uint8]
    size_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Drawn objects of a sensor.

    Attributes
    ----------
    pose : Pose or None
        Mounting; None if it is unknown and there are several sensors, so that the platform view omits this one.
    stamp : Stamp
        Stamp of the image.
    time_s : float
        Time of the image by the clock of its source.
    overdue : bool
        True if the image is so old that the sensor may have failed. It is drawn dim, and not fused.
    picture : (row, column, 3) uint8
        Picture of range and azimuth, or of an acoustic map, with axes.
    shape : Sector or Dome, optional
        Image on the platform; None if it is part of a fused image, or not drawn.
    position_m : (point, axis) float32
        Points in the platform frame.
    colours : (point, 3) uint8
        Colours of the points by level.
    share_left : (point,) float32
        Brightness of each point: 1 for a new one, 0 for a faded one.
    n_points : int
        Number of points of the latest image.
    """

    pose: Pose | None
    stamp: Stamp
    time_s: float
    overdue: bool
    picture: NDArray[np.uint8]
    shape: Sector | Dome | None
    position_m: NDArray[np.float32]
    colours: NDArray[np.uint8]
    share_left: NDArray[np.float32]
    n_points: int


@dataclass(frozen=True, slots=True)
class BandLevel:
    """Loudest direction of a band, of all sensors.

    Attributes
    ----------
    band_hz : (low, high), optional
        None for the sum of all bands.
    level_db : float
        -inf for silence.
    sensor : str
    azimuth_deg, elevation_deg : float
    is_shown : bool
        True for the band of the pictures.
    """

    band_hz: tuple[float, float] | None
    level_db: float
    sensor: str
    azimuth_deg: float
    elevation_deg: float
    is_shown: bool

    @property
    def centre_hz(self) -> float | None:
        """Geometric mean of the edges; None for the sum of all bands."""
        return None if self.band_hz is None else math.sqrt(self.band_hz[0] * self.band_hz[1])


@dataclass(frozen=True, slots=True)
class LevelScale:
    """Levels of the darkest and the brightest colour of acoustic maps, and the levels of the bands.

    Attributes
    ----------
    low_db, high_db : float
    unit : {"dBFS", "dB re 20 µPa", "dB re 20 µPa at 1 m", "dB"}
        Sound pressure level if the settings of all sensors state the sensitivity of the microphones. ``dB`` for the
        method ``music``, whose numbers have no reference.
    bands : tuple of BandLevel
        The sum of all bands, and each band by frequency.
    """

    low_db: float
    high_db: float
    unit: Unit
    bands: tuple[BandLevel, ...]

    def shade(self, level_db: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the colours of levels: 0 for the darkest, 255 for the brightest."""
        share = np.clip((level_db - self.low_db) / (self.high_db - self.low_db), 0, 1)
        return np.asarray(np.rint(255 * share), dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class DrawnFrame:
    """Drawn objects of all sensors.

    Attributes
    ----------
    sensors : dict of str to Drawn
        Drawn objects by the name of the sensor.
    range_m : float
        Largest range on display.
    fused : Sector, optional
        Fused image of several level sensors, without overdue ones. None with fewer than two, or if one is tilted or
        has elevations.
    height_m : float
        Height of the fused image on the platform.
    until_s : float
        Time by the clock of the source until which the frame is valid without new images: then a point fades, or a
        sensor becomes overdue.
    scale : LevelScale, optional
        Colours of acoustic maps; None for images.
    """

    sensors: dict[str, Drawn]
    range_m: float
    fused: Sector | None = None
    height_m: float = 0.0
    until_s: float = math.inf
    scale: LevelScale | None = None

    @property
    def unit(self) -> str:
        """Unit of the levels in the pictures."""
        return "dB re strongest" if self.scale is None else self.scale.unit

    @property
    def centre_m(self) -> tuple[float, float, float]:
        """Centre, on the platform, of the visible area."""
        ahead_m = np.array([[self.range_m / 2, 0, 0]], np.float32)
        middles_m = [drawn.pose.placed(ahead_m)[0] for drawn in self.sensors.values() if drawn.pose is not None]
        x, y, z = np.mean(middles_m, axis=0).tolist() if middles_m else (0.0, 0.0, 0.0)
        return x, y, z
