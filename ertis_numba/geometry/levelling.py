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
    """Return directions of the sensor frame for given directions relative to the horizontal plane.

    The level frame has the origin and the heading of the sensor, and its z axis points up. With the rotation matrix R
    of the sensor in the world and the heading ψ of its x axis, a direction d of the level frame is ``Rᵀ Rz(ψ) d`` in
    the sensor frame. Jansen, Laurijssen and Steckel (arXiv 2406.06255) thus compensate the pitch of a vehicle; this
    function also compensates roll. ``grid``: directions in the level frame. ``attitude_xyzw`` (4,) array_like of float:
    unit quaternion that rotates the sensor frame into the world frame. ``turned``: the same directions in the sensor
    frame. ``is_behind`` (direction,) bool: True for directions with x ≥ 0 in the level frame that lie behind the
    sensor. A planar array cannot distinguish them from directions in front. Raise ArgumentError if the quaternion is
    invalid, or the sensor looks straight up or down, so that it has no heading.

    Examples
    --------
    >>> import numpy as np
    >>> from ertis_numba.geometry import Grid, levelled_grid
    >>> from scipy.spatial.transform import Rotation
    >>> ahead = Grid(np.array([0.0]), np.array([0.0]))
    >>> nose_down = Rotation.from_euler("y", 10, degrees=True).as_quat()
    >>> turned, _ = levelled_grid(ahead, nose_down)
    >>> turned.elevation_deg.round(6).tolist()
    [10.0]
    """
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
