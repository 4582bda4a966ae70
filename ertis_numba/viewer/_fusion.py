"""Fusion of the images of several sensors in the horizontal plane of the platform."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.viewer._polar import Polar, PolarSampling
from ertis_numba.viewer._shapes import Pose, Sector

__all__ = ["Fusion", "is_level"]

_PIXELS: Final = 400  # Along the longer side.
_TILT: Final = math.sin(math.radians(0.5))  # Vertical component of an axis, below which a sensor is horizontal.


def is_level(pose: Pose) -> bool:
    """Return True if the image plane of a sensor lies in the horizontal plane of the platform."""
    x, y, _, _ = pose.rotation_xyzw
    return 2 * math.hypot(x, y) < _TILT


class Fusion:
    """Fusion of planar images of horizontal sensors: the maximum at each point of the platform.

    Levels are relative to the strongest of each sensor, as in its own picture.

    Parameters
    ----------
    sensors : sequence of (Polar, Pose)
    """

    def __init__(self, sensors: Sequence[tuple[Polar, Pose]]) -> None:
        corners_m = np.concatenate([_corners_m(polar, pose) for polar, pose in sensors])
        (first_x, first_y), (last_x, last_y) = corners_m.min(axis=0).tolist(), corners_m.max(axis=0).tolist()
        step_m = max(last_x - first_x, last_y - first_y) / _PIXELS
        columns = max(1, round((last_y - first_y) / step_m))
        rows = max(1, round((last_x - first_x) / step_m))
        self._shape = rows, columns
        self.extent_m = (-last_y, -last_y + columns * step_m, last_x - rows * step_m, last_x)
        x_m = np.repeat(last_x - (np.arange(rows) + 0.5) * step_m, columns)
        y_m = np.tile(last_y - (np.arange(columns) + 0.5) * step_m, rows)
        self._looks: list[PolarSampling] = []
        for polar, pose in sensors:
            yaw_rad = _yaw_rad(pose)
            from_x, from_y = x_m - pose.translation_m[0], y_m - pose.translation_m[1]
            ahead_m = math.cos(yaw_rad) * from_x + math.sin(yaw_rad) * from_y
            left_m = math.cos(yaw_rad) * from_y - math.sin(yaw_rad) * from_x
            self._looks.append(polar.look(-left_m, ahead_m))
        self.height_m = min(pose.translation_m[2] for _, pose in sensors)

    def __call__(self, levels: Sequence[NDArray[np.uint8]], table: NDArray[np.uint8]) -> Sector:
        """Return the image, in the frame of the platform.

        Parameters
        ----------
        levels : sequence of (azimuth, range) uint8
            Results of `Polar.levels`, in the order of the sensors.
        table : (256, 3) uint8
            Colours of levels.
        """
        rows, columns = self._shape
        highest = np.zeros(rows * columns, dtype=np.uint8)
        made = np.zeros((rows, columns, 4), dtype=np.uint8)
        flat = made.reshape(-1, 4)
        for look, each in zip(self._looks, levels, strict=True):
            highest[look.places] = np.maximum(highest[look.places], look(each))
            flat[look.places, 3] = 255
        flat[:, :3] = table[highest]
        return Sector(made, self.extent_m)


def _yaw_rad(pose: Pose) -> float:
    _, _, z, w = pose.rotation_xyzw
    return 2 * math.atan2(z, w)


def _corners_m(polar: Polar, pose: Pose) -> NDArray[np.float64]:
    """Return the corners of a sector's box on the platform: (4, 2)."""
    west, east, low, high = polar.extent_m
    yaw_rad = _yaw_rad(pose)
    ahead_m, right_m = np.array([low, low, high, high]), np.array([west, east, west, east])
    x_m = pose.translation_m[0] + math.cos(yaw_rad) * ahead_m + math.sin(yaw_rad) * right_m
    y_m = pose.translation_m[1] + math.sin(yaw_rad) * ahead_m - math.cos(yaw_rad) * right_m
    return np.stack([x_m, y_m], axis=1)
