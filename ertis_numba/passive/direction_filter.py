"""Kalman filter of a direction that moves on a sphere."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Bearing
from ertis_numba.geometry import unit_vectors
from ertis_numba.passive.likelihood import moved, tangents

__all__ = ["DirectionFilter", "direction_of"]

Floats = NDArray[np.float64]

_UNKNOWN_RAD: Final = math.pi  # Standard deviation of an angle that an array does not resolve.


def direction_of(bearing: Bearing) -> Floats:
    """Return a bearing as a unit vector: (axis,) float64."""
    return np.asarray(unit_vectors(np.array([bearing.azimuth_rad]), np.array([bearing.elevation_rad]))[0])


class DirectionFilter:
    """Kalman filter of a direction and its velocity in the plane that touches the sphere there.

    The velocity changes by white noise (Y. Bar-Shalom, X. Li and T. Kirubarajan, Estimation with Applications to
    Tracking and Navigation, 2001, section 6.2.2), with the root of the power density ``acceleration_deg_s`` in °/s in a
    second. After each bearing, the plane moves to the new direction. ``array_error_deg`` is the standard deviation that
    bearings do not state. ``speed_deg_s`` is that of the first velocity. The covariance (4, 4) is that of offsets
    sideways and upwards in radians, and of the velocity.
    """

    def __init__(
        self, bearing: Bearing, *, acceleration_deg_s: float, speed_deg_s: float, array_error_deg: float
    ) -> None:
        self._density = math.radians(acceleration_deg_s) ** 2
        self._floor = math.radians(array_error_deg) ** 2 * np.eye(2)
        self.direction, self.velocity_rad_s = direction_of(bearing), np.zeros(2)
        self.covariance = np.zeros((4, 4))
        self.covariance[:2, :2] = self._noise(bearing)
        self.covariance[2:, 2:] = math.radians(speed_deg_s) ** 2 * np.eye(2)

    def predict(self, duration_s: float) -> None:
        """Move the direction by its velocity for a duration."""
        self._move(self.velocity_rad_s * duration_s)
        step = np.eye(4)
        step[:2, 2:] = duration_s * np.eye(2)
        powers = np.array([[duration_s**3 / 3, duration_s**2 / 2], [duration_s**2 / 2, duration_s]])
        self.covariance = step @ self.covariance @ step.T + self._density * np.kron(powers, np.eye(2))

    def distance(self, bearing: Bearing) -> float:
        """Return the squared Mahalanobis distance of a bearing: χ² with two degrees of freedom for its own source."""
        offset = self._offset(bearing)
        if offset is None:
            return math.inf
        return float(offset @ np.linalg.solve(self.covariance[:2, :2] + self._noise(bearing), offset))

    def update(self, bearing: Bearing) -> None:
        """Correct the direction by a bearing."""
        offset = self._offset(bearing)
        if offset is None:
            return
        gain = np.linalg.solve(self.covariance[:2, :2] + self._noise(bearing), self.covariance[:2]).T
        change = gain @ offset
        kept = np.eye(4)
        kept[:, :2] -= gain
        self.covariance = kept @ self.covariance @ kept.T + gain @ self._noise(bearing) @ gain.T
        self.velocity_rad_s = self.velocity_rad_s + change[2:]
        self._move(change[:2])

    def _offset(self, bearing: Bearing) -> Floats | None:
        """Return the offset of a bearing in the plane in radians; None on the other half of the sphere."""
        there = direction_of(bearing)
        ahead = float(there @ self.direction)
        return tangents(self.direction) @ there / ahead if ahead > 0 else None

    def _noise(self, bearing: Bearing) -> Floats:
        sizes = np.minimum(np.radians([bearing.sideways_deg, bearing.upwards_deg]), _UNKNOWN_RAD)
        both = bearing.correlation * sizes[0] * sizes[1]
        return np.array([[sizes[0] ** 2, both], [both, sizes[1] ** 2]]) + self._floor

    def _move(self, offset_rad: Floats) -> None:
        """Move the plane, and turn velocity and covariance into its axes."""
        before = tangents(self.direction)
        self.direction = moved(self.direction, offset_rad[None], level=False)[0]
        u, _, v = np.linalg.svd(tangents(self.direction) @ before.T)
        turn = u @ v
        self.velocity_rad_s = turn @ self.velocity_rad_s
        both = np.kron(np.eye(2), turn)
        self.covariance = both @ self.covariance @ both.T
