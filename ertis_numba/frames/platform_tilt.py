"""Attitude of a platform: poses of a frame that is not upright, such as that of a camera."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["tilt_note", "turned_axes"]

Floats = NDArray[np.float64]

_FROM_PLATFORM_XYZW: Final = (0.5, -0.5, 0.5, 0.5)
"""Rotation from the axes of a platform, x forward and z up, to those of a camera, z forward and y down."""
_UPRIGHT: Final = float(np.cos(np.radians(30.0)))
_AXIS: Final = 0.6  # Mean vertical share of an axis that points up or down.
_STEEP: Final = float(np.tan(np.radians(30.0)))
_SHORT_M: Final = 0.5  # Path whose slope says nothing.
_USE: Final = "use --pose-axes {0} of 'ertis import-poses' or 'ertis map' (in Python, Trajectory.converted('{0}'))"


def tilt_note(rotation_xyzw: Floats, position_m: Floats) -> str | None:
    """Return a note if most poses tilt the platform by more than 30°, or if the path is steeper than 30°.

    Poses of a camera, with z forward and y down, lay the platform on its side. If the world has the axes of a camera as
    well, the platform seems to climb.

    Parameters
    ----------
    rotation_xyzw : (pose, 4) float64
        Unit quaternions from the platform frame to the world frame.
    position_m : (pose, 3) float64

    Returns
    -------
    str or None
    """
    up = _vertical_shares(rotation_xyzw)
    is_tilted = up[:, 2] < _UPRIGHT
    if 2 * np.count_nonzero(is_tilted) > len(is_tilted):
        tilt_deg = float(np.degrees(np.median(np.arccos(np.clip(up[:, 2], -1.0, 1.0)))))
        along_y = 1 - 2 * (rotation_xyzw[:, 0] ** 2 + rotation_xyzw[:, 2] ** 2)  # of the y axes of platform and world
        return (
            f"most poses tilt the platform by more than 30°: its z axis is {tilt_deg:.0f}° from vertical"
            f"{_axis_up(up.mean(axis=0), float(along_y.mean()))}"
        )
    spread_m = np.ptp(position_m, axis=0)
    if spread_m[2] > _SHORT_M and spread_m[2] > _STEEP * np.hypot(*spread_m[:2]):
        return (
            f"the path is {spread_m[2]:.3g} m high and {np.hypot(*spread_m[:2]):.3g} m long on the ground; if the z "
            f"axis of the world does not point up, as with many cameras, {_USE.format('camera-world')}"
        )
    return None


def turned_axes(rotation_xyzw: Floats, axes: str) -> tuple[Floats, Floats]:
    """Return the rotations of a platform for those of a frame with other axes, and the rotation of the world.

    Parameters
    ----------
    rotation_xyzw : (pose, 4) float64
    axes : {"platform", "camera", "camera-world"}

    Returns
    -------
    rotation_xyzw : (pose, 4) float64
    world : (3, 3) float64
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  importing it takes longer than this package

    if axes == "platform":
        return rotation_xyzw, np.eye(3)
    from_platform = Rotation.from_quat(_FROM_PLATFORM_XYZW)
    turned = Rotation.from_quat(rotation_xyzw) * from_platform
    if axes == "camera":
        return turned.as_quat(), np.eye(3)
    to_platform = from_platform.inv()
    return (to_platform * turned).as_quat(), to_platform.as_matrix()


def _vertical_shares(rotation_xyzw: Floats) -> Floats:
    """Return the vertical components of the x, y and z axes of the platform: (pose, axis) float64."""
    x, y, z, w = rotation_xyzw.T
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)


def _axis_up(up: Floats, along_y: float) -> str:
    """Return which axis points up, and the remedy."""
    wanted = "poses of the platform have x forward, y left and z up"
    if along_y > _AXIS:
        return f", as of a camera that turns about the y axis of the world; {_USE.format('camera-world')}"
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) < _AXIS:
        return f", and no axis always points up; {wanted}; for poses of a camera, {_USE.format('camera')}"
    found = f", and its {'−' if up[axis] < 0 else ''}{'xyz'[axis]} axis points up"
    if axis == 1 and up[axis] < 0:
        return f"{found}, as that of a camera does (z forward, y down); {_USE.format('camera')}"
    turned = "" if axis == len(up) - 1 and up[axis] > 0 else found
    order = ", and quaternions the order x, y, z, w" if axis == len(up) - 1 and turned else ""
    return f"{turned}; {wanted}{order}; correct the poses, or ignore this note if the platform really moves so"
