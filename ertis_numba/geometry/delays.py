"""When sound from a direction, or from a point, reaches the microphones."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["far_field_delays", "spherical_delays", "unit_vectors"]


def unit_vectors(azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions as unit vectors in the sensor frame.

    Parameters
    ----------
    azimuth_rad, elevation_rad : (direction,) float64

    Returns
    -------
    (direction, axis) float64
    """
    level = np.cos(elevation_rad)
    return np.stack([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=-1)


def far_field_delays(
    positions_m: NDArray[np.float64], directions: NDArray[np.float64], *, sound_speed_m_s: float
) -> NDArray[np.float64]:
    """Return when a plane wave reaches each microphone, after it passed the centroid.

    Parameters
    ----------
    positions_m : (mic, axis) float64
    directions : (direction, axis) float64
        Unit vectors towards the source.
    sound_speed_m_s : float

    Returns
    -------
    (direction, mic) float64
        ``−p·u / c`` in seconds.
    """
    return -(directions @ positions_m.T) / sound_speed_m_s


def spherical_delays(
    positions_m: NDArray[np.float64],
    directions: NDArray[np.float64],
    *,
    range_m: float,
    sound_speed_m_s: float,
) -> NDArray[np.float64]:
    """Return when the echo of a point reaches each microphone, after it would reach the centroid.

    As `far_field_delays`, for a point at ``range_m``: ``(‖r u − p‖ − r) / c``.

    Parameters
    ----------
    positions_m : (mic, axis) float64
    directions : (direction, axis) float64
        Unit vectors towards the point.
    range_m : float
        Distance of the point from the centroid.
    sound_speed_m_s : float

    Returns
    -------
    (direction, mic) float64
        Seconds.
    """
    points_m = range_m * directions[:, None, :] - positions_m[None, :, :]
    return np.asarray((np.linalg.norm(points_m, axis=-1) - range_m) / sound_speed_m_s)
