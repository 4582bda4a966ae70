"""Velocity of a platform from two groups of images."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Energyscape, PointCloud, Stamp
from ertis_numba.fusion.pulses import is_same_pulse
from ertis_numba.fusion.rig import Mountings, mounted_sensors
from ertis_numba.motion.echoes import EchoExtractor
from ertis_numba.motion.flow import FlowFit, fit_flow
from ertis_numba.motion.residuals import twist_of

__all__ = ["EgoVelocity", "Item", "ego_velocity", "grouped", "stamp_of", "time_after_ns", "times_ns_of", "velocity_of"]

Item: TypeAlias = Energyscape | PointCloud
Floats = NDArray[np.float64]

MAX_TIME_S = 1.0
"""Longest time between two groups; reflectors are out of sight or moved after longer ones."""


@dataclass(frozen=True, slots=True, eq=False)
class EgoVelocity:
    """Velocity of a platform in its own frame, in the horizontal plane.

    Attributes
    ----------
    velocity_m_s : (2,) float64
        Velocity forward and to the left in metres per second: the mean between both groups.
    yaw_rate_rad_s : float
        Rate of the turn to the left in radians per second.
    covariance : (3, 3) float64
        Covariance of forward velocity, velocity to the left, and yaw rate, in SI units.
    timestamp_ns : int
        Time of the second group.
    time_s : float
        Time between both groups in seconds.
    n_matches : int
        Number of echoes that both groups show.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> velocity = ertis.EgoVelocity(np.array([0.5, 0.0]), 0.1, np.diag([1e-4, 1e-4, 1e-4]), 0, 0.1, 40)
    >>> velocity.sd.round(3).tolist()
    [0.01, 0.01, 0.01]
    """

    velocity_m_s: Floats
    yaw_rate_rad_s: float
    covariance: Floats
    timestamp_ns: int
    time_s: float
    n_matches: int

    @property
    def sd(self) -> Floats:
        """Standard deviations of forward velocity, velocity to the left, and yaw rate: (3,) float64."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def ego_velocity(
    before: Iterable[Item], after: Iterable[Item], mountings: Mountings, *, alone: bool | None = None
) -> EgoVelocity:
    """Return the velocity of a platform from the images of two SYNC pulses; use `Odometry` for several.

    Echoes of reflectors at rest shift in range and azimuth as the platform moves. The velocity is that which explains
    the shifts of echoes in most places. Other echoes, such as those of moving people, are ignored. If another velocity
    explains about as much, the covariance includes it. Such velocities are 0, that of moving objects, and, if all flat
    arrays face along one line, the mirrored one: they show echoes from behind as if they came from ahead.

    Parameters
    ----------
    before, after : iterable of Energyscape or PointCloud
        Images or point clouds of two successive SYNC pulses, at most one of each sensor.
    mountings : mapping of str to (translation_m, rotation_xyzw)
        Mountings of the sensors, as for `Fuser`.
    alone : bool, optional
        True if no sensor emits except those with images, as for `Odometry`.

    Raises
    ------
    ArgumentError
        A group is empty or has two images of a sensor, or a mounting is missing or invalid.
    DataError
        Times do not increase, the groups share no sensor, or no more echoes match than those of noise or of one
        moving object.

    Examples
    --------
    Here, the point clouds are 5 cm apart:

    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> draws = np.random.default_rng(1)
    >>> place_m = np.column_stack([draws.uniform(1, 3, 30), draws.uniform(-1.5, 1.5, 30), np.zeros(30)])
    >>> clouds = [
    ...     ertis.PointCloud(
    ...         (place_m - [0.05 * pulse, 0, 0]).astype(np.float32),
    ...         np.ones(30, np.float32),
    ...         ertis.Settings(),
    ...         ertis.Stamp(sync_count=pulse, timestamp_ns=100_000_000 * pulse),
    ...     )
    ...     for pulse in (0, 1)
    ... ]
    >>> mountings = {"sensor": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}
    >>> ertis.ego_velocity([clouds[0]], [clouds[1]], mountings).velocity_m_s.round(2).tolist()
    [0.5, 0.0]
    """
    sensors = mounted_sensors(mountings)
    groups = [grouped(before, "before"), grouped(after, "after")]
    first, second = (stamp_of(group) for group in groups)
    time_s = (time_after_ns(groups[1], times_ns_of(groups[0]), first.timestamp_ns) - first.timestamp_ns) / 1e9
    if not 0 < time_s <= MAX_TIME_S:
        raise DataError(
            f"after is {time_s:.3g} s later than before; use groups in order of time, at most {MAX_TIME_S:g} s apart"
        )
    if not groups[0].keys() & groups[1].keys():
        raise DataError(
            f"before has sensors {', '.join(groups[0])}, and after has {', '.join(groups[1])}; use images of the same "
            "sensors"
        )
    extract = EchoExtractor(sensors, alone=alone)
    found = fit_flow(extract(groups[0]), extract(groups[1]), sensors, time_s)
    if found is None:
        raise DataError(
            "too few echoes of before and after match; use images that show more reflectors, or images closer in time"
        )
    if not found.is_significant:
        places = f"{found.n_places} place{'' if found.n_places == 1 else 's'}"
        raise DataError(
            f"only {found.n_matches} echoes of before and after match, in {places}, as many as echoes "
            "of noise or of one moving object; use images that show more reflectors, or images closer in time"
        )
    return velocity_of(found, second.timestamp_ns, time_s)


def velocity_of(found: FlowFit, timestamp_ns: int, time_s: float) -> EgoVelocity:
    """Return the velocity that causes a displacement within some time."""
    twist = twist_of(found.displacement, time_s)
    return EgoVelocity(twist[:2], float(twist[2]), found.covariance / time_s**2, timestamp_ns, time_s, found.n_matches)


def grouped(items: Iterable[Item], name: str) -> Mapping[str, Item]:
    """Return the items of a SYNC pulse, by sensor; raise ArgumentError or DataError if they do not form one."""
    if not isinstance(items, Iterable):
        raise ArgumentError(f"{name} is a {type(items).__name__}; pass a list of images or point clouds")
    group: dict[str, Item] = {}
    for item in items:
        if not isinstance(item, Energyscape | PointCloud):
            raise ArgumentError(f"{name} has a {type(item).__name__}; pass images of Pipeline.process, or point clouds")
        sensor = item.stamp.sensor
        item.settings.processing.require_sensor_frame("odometry needs directions of each sensor")
        if sensor in group:
            raise ArgumentError(f"{name} has two items of sensor {sensor!r}; pass one item of each sensor")
        group[sensor] = item
    if not group:
        raise ArgumentError(f"{name} is empty; pass the images or point clouds of one SYNC pulse")
    first, *others = group.values()
    for other in others:
        if not is_same_pulse(other.stamp, first.stamp):
            raise DataError(
                f"sensors {first.stamp.sensor!r} and {other.stamp.sensor!r} in {name} are not from the same pulse: "
                f"SYNC counts {first.stamp.sync_count} and {other.stamp.sync_count}, "
                f"{abs(other.stamp.timestamp_ns - first.stamp.timestamp_ns) / 1e9:.3g} s apart; use items of equal "
                "count"
            )
    return group


def stamp_of(group: Mapping[str, Item]) -> Stamp:
    """Return the earliest stamp of a group, which is the time of its pulse, as in `Fuser`."""
    return min((item.stamp for item in group.values()), key=lambda stamp: stamp.timestamp_ns)


def times_ns_of(group: Mapping[str, Item]) -> dict[str, int]:
    """Return the times of a group, by sensor."""
    return {sensor: item.stamp.timestamp_ns for sensor, item in group.items()}


def time_after_ns(group: Mapping[str, Item], before: Mapping[str, int], before_ns: int) -> int:
    """Return the time of a group after another one, by the clocks of the sensors of both."""
    # Clocks of sensors may differ by more than a period of SYNC, so the median of the times by each clock counts.
    passed_ns = [time_ns - before[sensor] for sensor, time_ns in times_ns_of(group).items() if sensor in before]
    return before_ns + round(float(np.median(passed_ns))) if passed_ns else stamp_of(group).timestamp_ns
