"""Compensation of points for the motion of their sensor during the measurement."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import PointCloud
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.motion.echoes import sweep_delay_s

__all__ = ["compensate_motion"]

_MAX_SPEED_M_S = 100.0
_MAX_YAW_RATE_RAD_S = 100.0


def compensate_motion(points: PointCloud, velocity_m_s: Sequence[float], yaw_rate_rad_s: float = 0.0) -> PointCloud:
    """Return points at rest as they were at the start of the measurement.

    A point appears at the range at which it is when the sound meets it, and in the direction in which it is when the
    middle of the call returns. A sensor that moves at 1 m/s sees a point at 5 m about 12 mm too near; one that turns at
    90°/s sees it 2.7° aside. Ranges are also shifted by the Doppler coupling of the sweep, which is
    ``T = D / (f_start / f_stop - 1)`` for a sweep of the duration D. For a point that appears at p, at the
    range r, from a sensor with the velocity v and the yaw rate ω:

    ``q = R(ω t) p + (r / c - T) v₁ + t v₂``, with ``t = 2 r / c + D / 2``

    where v₁ and v₂ are the parts of the velocity along and across the direction of the point. The velocity also scales
    the angle off the axis by ``v / c``, which is left out: 0.2° at 45° for 1.5 m/s.

    Parameters
    ----------
    points : PointCloud
        Points of one measurement or of a fused group.
    velocity_m_s : (3,) sequence of float
        Velocity of the sensor or the platform in the frame of the points, in metres per second.
    yaw_rate_rad_s : float, default 0
        Rotation to the left about the z axis of this frame, in radians per second.

    Raises
    ------
    ArgumentError
        The points are no point cloud, or a velocity is not finite or out of range.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     image = ertis.Pipeline(recording.settings).process(recording[0])
    >>> points = ertis.PointExtractor(image.settings)(image)
    >>> at_rest = ertis.compensate_motion(points, (1.0, 0.0, 0.0))
    >>> at_rest.position_m.shape == points.position_m.shape
    True
    """
    checks.instance("points", points, PointCloud, "PointExtractor returns")
    try:
        velocity = np.asarray(velocity_m_s, np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"velocity_m_s is {velocity_m_s!r:.80}; use x, y, z in metres per second") from error
    if velocity.shape != (3,):
        raise ArgumentError(f"velocity_m_s has shape {velocity.shape}; use x, y, z in metres per second")
    for part in velocity.tolist():
        checks.between("velocity_m_s", part, -_MAX_SPEED_M_S, _MAX_SPEED_M_S)
    checks.between("yaw_rate_rad_s", yaw_rate_rad_s, -_MAX_YAW_RATE_RAD_S, _MAX_YAW_RATE_RAD_S)
    position_m = points.position_m.astype(np.float64)
    range_m = np.linalg.norm(position_m, axis=1)
    one_way_s = range_m / sound_speed_m_s(points.settings.air)
    call = points.settings.call
    middle_s = call.start_s + 2 * one_way_s + call.duration_s / 2
    turned_m = Rotation.from_rotvec(np.outer(yaw_rate_rad_s * middle_s, (0.0, 0.0, 1.0))).apply(position_m)
    ahead = np.divide(turned_m, range_m[:, None], out=np.zeros_like(turned_m), where=range_m[:, None] > 0)
    along_m_s = (ahead @ velocity)[:, None] * ahead
    early_s = call.start_s + one_way_s - sweep_delay_s(call)
    at_rest_m = turned_m + early_s[:, None] * along_m_s + middle_s[:, None] * (velocity - along_m_s)
    return points.replace(position_m=at_rest_m.astype(points.position_m.dtype))
