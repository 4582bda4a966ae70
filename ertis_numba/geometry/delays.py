"""Delays of sound from a direction, or from a point, at the microphones."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["far_field_delays", "spherical_delays", "unit_vectors"]


def unit_vectors(azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions as unit vectors in the sensor frame: (direction, axis)."""
    level = np.cos(elevation_rad)
    return np.stack([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=-1)


def far_field_delays(
    positions_m: NDArray[np.float64], directions: NDArray[np.float64], *, sound_speed_m_s: float
) -> NDArray[np.float64]:
    """Return the delays of plane waves, ``−p·u / c``, in s: (direction, mic), relative to the centroid."""
    return -(directions @ positions_m.T) / sound_speed_m_s


def spherical_delays(
    positions_m: NDArray[np.float64],
    directions: NDArray[np.float64],
    *,
    range_m: float,
    sound_speed_m_s: float,
) -> NDArray[np.float64]:
    """Return the delays of point echoes, ``(‖r u − p‖ − r) / c``, in s: (direction, mic), relative to the centroid."""
    points_m = range_m * directions[:, None, :] - positions_m[None, :, :]
    return np.asarray((np.linalg.norm(points_m, axis=-1) - range_m) / sound_speed_m_s)
