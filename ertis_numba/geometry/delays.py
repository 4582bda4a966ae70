"""Delays of sound from a direction, or from a point, at the microphones."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["far_field_delays", "spherical_delays", "unit_vectors"]


def unit_vectors(azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions as unit vectors in the sensor frame: (direction, axis).

    Examples
    --------
    >>> import numpy as np
    >>> from ertis_numba.geometry import unit_vectors
    >>> unit_vectors(np.radians([90.0]), np.array([0.0])).round(6).tolist()
    [[0.0, 1.0, 0.0]]
    """
    level = np.cos(elevation_rad)
    return np.stack([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=-1)


def far_field_delays(
    positions_m: NDArray[np.float64], directions: NDArray[np.float64], *, sound_speed_m_s: float
) -> NDArray[np.float64]:
    """Return the delays of plane waves at each microphone, ``−p·u / c``, relative to the centroid: (direction, mic).

    The result is in seconds. Positions p (mic, axis) are relative to the centroid; u (direction, axis) are unit vectors
    towards the source.
    """
    return -(directions @ positions_m.T) / sound_speed_m_s


def spherical_delays(
    positions_m: NDArray[np.float64],
    directions: NDArray[np.float64],
    *,
    range_m: float,
    sound_speed_m_s: float,
) -> NDArray[np.float64]:
    """Return the delays of the echoes of points, ``(‖r u − p‖ − r) / c``, relative to the centroid: (direction, mic).

    The result is in seconds. Positions p (mic, axis) and the range r are relative to the centroid; u (direction, axis)
    are unit vectors towards the points.
    """
    points_m = range_m * directions[:, None, :] - positions_m[None, :, :]
    return np.asarray((np.linalg.norm(points_m, axis=-1) - range_m) / sound_speed_m_s)
