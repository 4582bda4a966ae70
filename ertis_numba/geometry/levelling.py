"""Directions relative to the horizontal plane, for a sensor that is tilted."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry.delays import unit_vectors
from ertis_numba.geometry.grids import Grid
from ertis_numba.geometry.mountings import require_unit_quaternion

__all__ = ["levelled_grid"]

_MIN_HORIZONTAL = 1e-3  # Horizontal part of the forward unit vector from which a sensor has a heading.
_ROUNDING = 1e-9


def levelled_grid(grid: Grid, attitude_xyzw: ArrayLike) -> tuple[Grid, NDArray[np.bool_]]:
    """Return directions of the level frame in the sensor frame, and a mask of those with x ≥ 0 behind the sensor."""
    # The result is `Rᵀ Rz(ψ) d` for the rotation R of the sensor in the world and its heading ψ (Jansen, Laurijssen and
    # Steckel, arXiv 2406.06255). Raise ArgumentError without a heading.
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  importing it takes longer than this package

    try:
        given_xyzw = np.asarray(attitude_xyzw, np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"attitude_xyzw is not made of numbers ({error}); use a unit quaternion x, y, z, w"
        ) from error
    require_unit_quaternion("attitude_xyzw", given_xyzw)
    rotation = Rotation.from_quat(given_xyzw).as_matrix()
    forward = rotation[:, 0]
    if np.hypot(*forward[:2]) < _MIN_HORIZONTAL:
        raise ArgumentError(
            "the sensor looks straight up or down, so its images have no level directions; leave out "
            "processing.level_directions"
        )
    heading_rad = np.arctan2(forward[1], forward[0])
    given = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    turned = given @ Rotation.from_euler("z", heading_rad).as_matrix().T @ rotation
    is_behind = (given[:, 0] >= -_ROUNDING) & (turned[:, 0] < -_ROUNDING)
    azimuth_rad = np.arctan2(turned[:, 1], turned[:, 0])
    return Grid(azimuth_rad, np.arcsin(np.clip(turned[:, 2], -1.0, 1.0))), is_behind
