"""Attitude of a platform: poses of a frame that is not upright, such as that of a camera."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["tilt_note", "turned_axes"]

Floats = NDArray[np.float64]

_FROM_PLATFORM_XYZW: Final = (0.5, -0.5, 0.5, 0.5)
"""Rotation from the axes of a platform, x forward and z up, to those of a camera, z forward and y down."""
_HALF_TURN_XYZW: Final = (1.0, 0.0, 0.0, 0.0)
"""Rotation from the axes of a platform to x forward, y right, z down."""
_MOST_DEG: Final = 30.0
_UPRIGHT: Final = float(np.cos(np.radians(_MOST_DEG)))
_LEVEL: Final = float(np.cos(np.radians(3.0)))
_TURN_DEG: Final = 20.0  # Change of tilt that is no ramp.
_AXIS: Final = 0.6  # Mean vertical share of an axis that points up or down.
_STEEP: Final = float(np.tan(np.radians(30.0)))
_SHORT_M: Final = 0.5  # Path whose slope says nothing.
_USE: Final = "convert them with --pose-axes {0} (ertis import poses, ertis map) or Trajectory.converted('{0}')"


def tilt_note(rotation_xyzw: Floats, position_m: Floats) -> str | None:
    """Return a note if poses tilt the platform as those of other frames or orders do."""
    # They tilt it by more than 30°, its path is steeper than 30°, or it is level in another order of the axes.
    up = _vertical_shares(rotation_xyzw)
    if (note := _order_note(rotation_xyzw, up)) is not None:
        return note
    is_tilted = up[:, 2] < _UPRIGHT
    if 2 * np.count_nonzero(is_tilted) > len(is_tilted):
        tilt_deg = float(np.median(_degrees(up[:, 2])))
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
    return _other_axis_note(rotation_xyzw, up)


def turned_axes(rotation_xyzw: Floats, axes: str) -> tuple[Floats, Floats]:
    """Return rotations (pose, 4) of a platform for those of a frame with other axes, and that of the world (3, 3)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  importing it takes longer than this package

    if axes == "platform":
        return rotation_xyzw, np.eye(3)
    turned = Rotation.from_quat(rotation_xyzw)
    if axes == "ned":
        over = Rotation.from_quat(_HALF_TURN_XYZW)
        return (over * turned * over).as_quat(), over.as_matrix()
    from_platform = Rotation.from_quat(_FROM_PLATFORM_XYZW)
    turned = turned * from_platform
    if axes == "camera":
        return turned.as_quat(), np.eye(3)
    to_platform = from_platform.inv()
    return (to_platform * turned).as_quat(), to_platform.as_matrix()


def _order_note(rotation_xyzw: Floats, up: Floats) -> str | None:
    """Return a note if the platform is level with quaternions in the order w, x, y, z, but tilted in the usual one."""
    tilts_deg = _degrees(up[:, 2])
    is_tilted = np.median(tilts_deg) > _MOST_DEG or np.ptp(tilts_deg) > _TURN_DEG
    if not is_tilted or _vertical_shares(np.roll(rotation_xyzw, -1, axis=1))[:, 2].min() < _LEVEL:
        return None
    return (
        f"quaternions in the order x, y, z, w tilt the platform by up to {tilts_deg.max():.0f}°, but it is level if "
        "their order is w, x, y, z; then name the columns in a first line, as in 'timestamp tx ty tz qw qx qy qz' "
        "(np.roll(q, -1, axis=1) in Python)"
    )


def _other_axis_note(rotation_xyzw: Floats, up: Floats) -> str | None:
    """Return a note if the platform turns about its x or y axis only, as where another axis than z is up."""
    tilts_deg = _degrees(up[:, 2])
    along = 1 - 2 * (np.sum(rotation_xyzw[:, :3] ** 2, axis=1)[:, None] - rotation_xyzw[:, :2] ** 2)
    axis = int(np.argmax(along.min(axis=0)))
    if np.ptp(tilts_deg) < _TURN_DEG or along[:, axis].min() < _LEVEL:
        return None
    name = "xy"[axis]
    return (
        f"the platform turns about its {name} axis only, by up to {np.ptp(tilts_deg):.0f}°, as if {name} were up or "
        "down; poses of the platform have x forward, y left and z up, so correct them, or ignore this if the platform "
        "really moves so"
    )


def _degrees(shares: Floats) -> Floats:
    return np.asarray(np.degrees(np.arccos(np.clip(shares, -1.0, 1.0))))


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
