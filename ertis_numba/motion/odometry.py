"""Odometry: path of a platform by integrating its motion between groups of images."""

import math
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.frames import Energyscape, Trajectory
from ertis_numba.fusion.rig import MountedSensor, Mountings, mounted_sensors
from ertis_numba.motion.echoes import EchoExtractor, GroupEchoes
from ertis_numba.motion.flow import FlowFit, fit_flow
from ertis_numba.motion.planar_pose import Doubt, PlanarPose, displacement_of, relative
from ertis_numba.motion.residuals import twist_of
from ertis_numba.motion.velocity import MAX_TIME_S, EgoVelocity, Item, grouped, time_after_ns, times_ns_of, velocity_of

__all__ = ["Odometry"]

Floats = NDArray[np.float64]

# Changes of speed and yaw rate between two groups that the search covers.
_MAX_CHANGE: Final = np.array([0.6, 0.6, math.radians(60.0)])
_KEYFRAME_REACH: Final = np.array([0.02, 0.02, math.radians(2.0)])
_KEYFRAME_M: Final = 0.3
_KEYFRAME_RAD: Final = math.radians(15.0)
# Matched echoes, and their share, below which a motion need not be near the last one.
_FEW_MATCHES: Final = 12
_DOUBTFUL_SHARE: Final = 0.25
_KEYFRAME_SHARE: Final = 0.5  # Share of the matches of the last two groups that a keyframe still has.
_PLANAR: Final = 0, 1, 5  # of x, y, z, and the rotations about them
# Standard deviations of an assumed velocity: x, y and yaw per second. They grow with the time since the last measured
# velocity, up to a limit. The example parameters of Nav2 for mobile robots permit accelerations of 2.5 m/s² and
# 3.2 rad/s². If all accelerations within these limits are equally likely, their standard deviations are 1.4 m/s² and
# 1.8 rad/s².
_UNKNOWN_SD: Final = np.array([0.5, 0.5, 1.0])
_ACCELERATION_SD: Final = np.array([1.4, 1.4, 1.8])


class _View(NamedTuple):
    """Echoes of a group, and the pose and twist of the platform; None if the twist is unknown."""

    echoes: GroupEchoes
    pose: PlanarPose
    twist: Floats | None
    change: Floats = np.zeros((3, 3))  # covariance of displacements from here, as the twist changed


class Odometry:
    """Integration of the motion between successive groups of images.

    Each group is compared with the one before, which yields the velocity, and with a keyframe up to 0.3 m back, which
    yields the pose. Errors of the pose thus grow with the number of keyframes rather than of groups.

    The covariance of a pose assumes that the errors of these comparisons are independent. It does not include errors of
    the mountings and of the temperature. An error of 1 K changes distances by 0.17 %.

    Parameters
    ----------
    mountings : mapping of str to (translation_m, rotation_xyzw)
        Mountings of the sensors, as for `Fuser`.
    alone : bool, optional
        True if no sensor emits except those with images. Then a flat array hears no calls of others from behind, which
        would appear as if the platform drove backwards, and nothing behind reflects the call of an omnidirectional
        emitter. By default, this is assumed only of a single piston that is the platform itself: at its origin, and
        with its heading.

    Raises
    ------
    ArgumentError
        A mounting is missing or invalid.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> odometry = ertis.Odometry({"sensor": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))})
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     velocity = odometry.add([ertis.Pipeline(recording.settings).process(recording[0])])
    >>> velocity is None, len(odometry.poses)
    (True, 1)
    >>> odometry.trajectory.position_m.tolist()
    [[0.0, 0.0, 0.0]]
    """

    def __init__(self, mountings: Mountings, *, alone: bool | None = None) -> None:
        self._sensors, self._alone = mounted_sensors(mountings), alone
        self._extract = EchoExtractor(self._sensors, alone=alone)
        self._last: _View | None = None
        self._keyframe: _View | None = None
        self._twist = np.zeros(3)
        self._twist_ns: int | None = None  # Time of the last measured twist.
        self._unknown = np.zeros(3)  # Standard deviations of the way since the last measured group.
        self._suspects: tuple[Floats, ...] = ()  # Twists of the last groups with several possible motions.
        self._path: list[PlanarPose] = []
        self._times_ns: dict[str, int] = {}  # of the last group, by sensor
        self._items: Mapping[str, Item] = {}  # of the last group

    @property
    def poses(self) -> tuple[PlanarPose, ...]:
        """Poses at all groups; the first one is the origin."""
        return tuple(self._path)

    @property
    def trajectory(self) -> Trajectory:
        """Poses at all groups, in the frame of the platform at the first group.

        They lie in the plane: z is 0, rotations are about z, and other covariances are 0.

        Raises
        ------
        DataError
            No group has been added.
        """
        if not self._path:
            raise DataError("there is no pose yet; add the images of at least one pulse")
        yaw_rad = np.array([pose.yaw_rad for pose in self._path])
        covariance = np.zeros((len(self._path), 6, 6))
        covariance[np.ix_(range(len(self._path)), _PLANAR, _PLANAR)] = [pose.covariance for pose in self._path]
        return Trajectory(
            np.array([pose.timestamp_ns for pose in self._path]),
            np.array([(pose.x_m, pose.y_m, 0.0) for pose in self._path]),
            np.outer(np.sin(yaw_rad / 2), [0, 0, 1, 0]) + np.outer(np.cos(yaw_rad / 2), [0, 0, 0, 1]),
            covariance,
            "odometry",
        )

    @property
    def length_m(self) -> float:
        """Length of the path in metres."""
        places = np.array([(pose.x_m, pose.y_m) for pose in self._path]).reshape(-1, 2)
        return float(np.sum(np.hypot(*np.diff(places, axis=0).T)))

    def remount(self, mountings: Mountings) -> None:
        """Use other mountings for the groups to come, for example after a sensor was added.

        Mountings that only append sensors keep the echoes of earlier groups. Otherwise, the next group is compared with
        no earlier one.

        Parameters
        ----------
        mountings : mapping of str to (translation_m, rotation_xyzw)

        Raises
        ------
        ArgumentError
            A mounting is missing or invalid.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> front, back = ((0.2, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), ((-0.2, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
        >>> odometry = ertis.Odometry({"front": front})
        >>> odometry.remount({"front": front, "back": back})
        """
        sensors = mounted_sensors(mountings)
        if not _begins_with(sensors, self._sensors):
            self._begin(None)
        self._sensors, self._extract = sensors, EchoExtractor(sensors, alone=self._alone)

    def add(self, group: Iterable[Item]) -> EgoVelocity | None:
        """Add the images of a SYNC pulse, and return the velocity since the one before.

        Parameters
        ----------
        group : iterable of Energyscape or PointCloud
            At most one item of each sensor. Sensors may be missing.

        Returns
        -------
        EgoVelocity or None
            None for the first group, and if the motion is unknown; `PlanarPose.doubt` states the reason.

        Raises
        ------
        ArgumentError
            The group is empty, has two items of a sensor, or one without mounting.
        DataError
            The group is not later than the one before, or its items are not of the same pulse.
        """
        items = grouped(group, "group")
        timestamp_ns = self.time_ns_of(items)
        if self._path and timestamp_ns <= self._path[-1].timestamp_ns:
            raise DataError(
                f"group is {(self._path[-1].timestamp_ns - timestamp_ns) / 1e9:.3g} s before the last one; add groups "
                "in order of time"
            )
        fresh = {name: item for name, item in items.items() if not _is_copy(item, self._items.get(name))}
        echoes = self._extract(fresh or items)
        self._times_ns, self._items = times_ns_of(items), items
        if not self._path:
            self._path.append(PlanarPose(timestamp_ns, 0.0, 0.0, 0.0, np.zeros((3, 3))))
            self._begin(echoes)
            return None
        time_s = (timestamp_ns - self._path[-1].timestamp_ns) / 1e9
        found = self._since_last(echoes, time_s) if fresh and time_s <= MAX_TIME_S else None
        if found is None or not found.is_certain:
            self._guess(found, time_s, timestamp_ns, has_copies=not fresh)
            self._begin(echoes if fresh else None)
            return None
        self._twist, self._twist_ns = twist_of(found.displacement, time_s), timestamp_ns
        change = _of_change(self._last.twist, self._twist, echoes) if self._last else np.zeros((3, 3))
        found = found._replace(covariance=found.covariance + change)
        self._unknown, self._suspects = np.zeros(3), ()
        self._locate(echoes, found, self._twist, change, timestamp_ns)
        self._last = _View(echoes, self._path[-1], self._twist)
        return velocity_of(found, timestamp_ns, time_s)

    def time_ns_of(self, group: Mapping[str, Item]) -> int:
        """Return the time of the pose that a group would add, by the clocks of its sensors at the last group.

        Clocks of sensors may differ, so the time since the last group is the median of that by each clock.

        Parameters
        ----------
        group : mapping of str to Energyscape or PointCloud
            Images or point clouds of a SYNC pulse, by sensor.

        Returns
        -------
        int
            Nanoseconds, as in `Stamp`.

        Examples
        --------
        >>> import ertis_numba as ertis
        >>> odometry = ertis.Odometry({"sensor": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))})
        >>> with ertis.open_recording("reflectors.h5") as recording:
        ...     image = ertis.Pipeline(recording.settings).process(recording[0])
        >>> odometry.time_ns_of({image.stamp.sensor: image}) == image.stamp.timestamp_ns
        True
        """
        last_ns = self._path[-1].timestamp_ns if self._path else 0
        return time_after_ns(group, self._times_ns, last_ns)

    def _guess(self, found: FlowFit | None, time_s: float, timestamp_ns: int, *, has_copies: bool) -> None:
        """Add the pose by the more likely of several motions, or else by the last velocity, for at most a second."""
        age_s = math.inf if self._twist_ns is None else (timestamp_ns - self._twist_ns) / 1e9
        if found is None:
            doubt: Doubt = "copies" if has_copies else "pause" if time_s > MAX_TIME_S else "few echoes"
            way = displacement_of(self._twist, max(0.0, min(time_s, MAX_TIME_S, MAX_TIME_S + time_s - age_s)))
            deviation = np.minimum(_UNKNOWN_SD, _ACCELERATION_SD * age_s) * time_s
        else:
            doubt, way, deviation = "other motion", found.displacement, np.sqrt(np.diag(found.covariance))
            self._suspects = twist_of(found.displacement, time_s), twist_of(found.other, time_s)
        before, self._unknown = self._unknown, self._unknown + deviation
        covariance = np.diag(self._unknown**2 - before**2)
        self._path.append(self._path[-1].moved(way, covariance, timestamp_ns, doubt))

    def _begin(self, echoes: GroupEchoes | None) -> None:
        self._last = None if echoes is None else _View(echoes, self._path[-1], None)
        self._keyframe = None

    def _since_last(self, echoes: GroupEchoes, time_s: float) -> FlowFit | None:
        last = self._last
        if last is None:
            return None
        if last.twist is None:
            suspects = [displacement_of(twist, time_s) for twist in self._suspects]
            return _significant(fit_flow(last.echoes, echoes, self._sensors, time_s, suspects=suspects))
        start = displacement_of(last.twist, time_s)
        near = fit_flow(
            last.echoes,
            echoes,
            self._sensors,
            time_s,
            start=start,
            reach=_MAX_CHANGE * time_s,
            first_twist=last.twist,
        )
        found = _significant(near)
        if found is not None and found.is_certain and found.n_matches > _FEW_MATCHES and found.share > _DOUBTFUL_SHARE:
            return found
        # The expectation may be wrong, so that all displacements are compared.
        other = fit_flow(last.echoes, echoes, self._sensors, time_s)
        fits = [each for each in (near, other) if each is not None]
        return _significant(max(fits, key=lambda each: each.score, default=None))

    def _locate(self, echoes: GroupEchoes, found: FlowFit, twist: Floats, change: Floats, timestamp_ns: int) -> None:
        """Add the pose relative to the keyframe, or to the last group if the keyframe is out of reach."""
        step = self._path[-1].moved(found.displacement, found.covariance, timestamp_ns)
        keyframe = self._keyframe
        if keyframe is not None:
            expected = relative(keyframe.pose, step)
            if math.hypot(*expected[:2]) < _KEYFRAME_M and abs(expected[2]) < _KEYFRAME_RAD:
                # A view keeps the twist that it had when it was located, so that errors of twists add up to nothing.
                fit = fit_flow(
                    keyframe.echoes,
                    echoes,
                    self._sensors,
                    (timestamp_ns - keyframe.pose.timestamp_ns) / 1e9,
                    start=expected,
                    reach=_KEYFRAME_REACH,
                    first_twist=twist if keyframe.twist is None else keyframe.twist,
                    second_twist=twist,
                )
                if fit is not None and _confirms(fit, found, expected):
                    self._path.append(
                        keyframe.pose.moved(fit.displacement, fit.covariance + change + keyframe.change, timestamp_ns)
                    )
                    return
        self._keyframe = self._last and self._last._replace(change=change)
        self._path.append(step)


def _is_copy(item: Item, last: Item | None) -> bool:
    """Return True if an image with sound equals the last one of its sensor in every value, as never happens."""
    return (
        isinstance(item, Energyscape)
        and isinstance(last, Energyscape)
        and bool(item.amplitude.any())
        and np.array_equal(item.amplitude, last.amplitude)
    )


def _significant(fit: FlowFit | None) -> FlowFit | None:
    """Return a fit if unrelated echoes do not match as well by accident."""
    return fit if fit is not None and fit.is_significant else None


def _of_change(before: Floats | None, after: Floats, echoes: GroupEchoes) -> Floats:
    """Return the covariance (3, 3) of a displacement by a change of the velocity at an unknown instant."""
    change = np.zeros(3) if before is None else after - before
    return np.asarray(np.diag((change * np.mean(echoes.arrival_s)) ** 2))


def _confirms(fit: FlowFit, found: FlowFit, expected: Floats) -> bool:
    """Return True if the fit since a keyframe agrees with that since the last group, and has enough matches."""
    is_near = bool(np.all(np.abs(fit.displacement - expected) < _KEYFRAME_REACH))
    return is_near and fit.n_matches > _KEYFRAME_SHARE * found.n_matches


def _begins_with(sensors: tuple[MountedSensor, ...], others: tuple[MountedSensor, ...]) -> bool:
    """Return True if the first sensors are those of others."""
    return len(sensors) >= len(others) and all(
        one.name == other.name
        and np.array_equal(one.translation_m, other.translation_m)
        and np.array_equal(one.rotation, other.rotation)
        for one, other in zip(sensors, others, strict=False)
    )
