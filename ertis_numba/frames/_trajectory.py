"""Trajectories: poses of a platform at increasing times."""

from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.base.units import counted
from ertis_numba.frames._replacing import replaced
from ertis_numba.frames.platform_tilt import turned_axes

__all__ = ["PoseAxes", "Trajectory"]

PoseAxes: TypeAlias = Literal["platform", "camera", "camera-world", "ned"]
"""Axes of the frame to which poses belong."""

_NS_PER_S: Final = 1e9
_MAX_TIME_NS: Final = 2**62  # Differences of such times fit into 64 bits.
_MAX_POSITION_M: Final = 1e8  # Beyond, float64 does not resolve nanometres.
_MARGIN_NS: Final = 1_000_000
_MAX_NORM_ERROR: Final = 1e-3  # Text files have few digits; a larger error is no rounding.
_MAX_ASYMMETRY: Final = 1e-6  # Relative to the largest element; single precision rounds less.
_MAX_ROUNDING: Final = 1e-14  # Error in the length of a quaternion that was normalised before.


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of a platform in the world frame at increasing times.

    The arrays are read-only copies.

    Attributes
    ----------
    time_ns : (pose,) int64
        Times in nanoseconds since 1970-01-01 UTC, on the clock of `Stamp.timestamp_ns`, strictly increasing.
    position_m : (pose, 3) float64
        Position of the platform's origin in the world frame, in metres.
    rotation_xyzw : (pose, 4) float64
        Unit quaternions that rotate the platform frame into the world frame. The constructor normalises them.
    covariance : (pose, 6, 6) float64, or None, default None
        Covariance of x, y, z and of the rotation about the world's x, y, z, in square metres and square radians, as in
        PoseWithCovariance of ROS. None if it is unknown.
    source : str, default ""
        Origin of the poses, such as "scene", "file", "application" or "odometry".
    max_gap_s : float or None, default None
        Longest interval between two poses in which poses are interpolated, in seconds. Longer intervals have no poses.
        None allows any interval.
    notes : tuple of str, default ()
        Findings of `read_trajectory` that matter to users, such as rows left out. Other trajectories have none.

    Raises
    ------
    ArgumentError
        The shapes do not match, a number is not finite, the times do not increase or exceed ±2⁶² ns, a quaternion is
        not of unit length, a covariance is not symmetric and positive semidefinite, or the longest interval is not
        above zero.

    Examples
    --------
    >>> from ertis_numba import Trajectory
    >>> identity = [0.0, 0.0, 0.0, 1.0]
    >>> path = Trajectory([0, 2_000_000_000], [[0, 0, 0], [1, 0, 0]], [identity, identity], source="file")
    >>> path.at([500_000_000]).position_m.tolist()
    [[0.25, 0.0, 0.0]]
    """

    time_ns: NDArray[np.int64]
    position_m: NDArray[np.float64]
    rotation_xyzw: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None
    source: str = ""
    max_gap_s: float | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        time_ns = _times("time_ns", self.time_ns)
        if not len(time_ns):
            raise ArgumentError("time_ns is empty; pass at least one pose")
        if time_ns.min() < -_MAX_TIME_NS or time_ns.max() > _MAX_TIME_NS:
            raise ArgumentError(
                f"time_ns runs from {time_ns.min()} to {time_ns.max()}; use nanoseconds since 1970 within "
                f"±{_MAX_TIME_NS}"
            )
        n_poses = len(time_ns)
        late = np.flatnonzero(np.diff(time_ns) <= 0)
        if late.size:
            first = late[0]
            raise ArgumentError(
                f"time_ns does not increase: {time_ns[first + 1]} at [{first + 1}] follows {time_ns[first]}; "
                "sort the poses by time, and keep one pose for each time"
            )
        rotation = _numbers("rotation_xyzw", self.rotation_xyzw, (n_poses, 4))
        with np.errstate(over="ignore"):
            norms = np.linalg.norm(rotation, axis=1)
        wrong = np.flatnonzero(np.abs(norms - 1) > _MAX_NORM_ERROR)
        if wrong.size:
            raise ArgumentError(
                f"rotation_xyzw has length {norms[wrong[0]]:g} at [{wrong[0]}]; pass unit quaternions x, y, z, w"
            )
        norms[np.abs(norms - 1) < _MAX_ROUNDING] = 1.0  # A copy has the same bits.
        covariance = self.covariance
        if covariance is not None:
            covariance = _covariances(covariance, n_poses)
        checks.instance("source", self.source, str, "names the origin of the poses")
        if self.max_gap_s is not None:
            checks.positive("max_gap_s", self.max_gap_s)
        position_m = _numbers("position_m", self.position_m, (n_poses, 3))
        farthest_m = float(np.max(np.abs(position_m)))
        if farthest_m > _MAX_POSITION_M:
            raise ArgumentError(
                f"position_m reaches {farthest_m:g} m; use metres within ±{_MAX_POSITION_M:g} m of the world's origin"
            )
        rotation = rotation / norms[:, None]
        fields = {
            "time_ns": time_ns, "position_m": position_m, "rotation_xyzw": rotation, "covariance": covariance
        }  # fmt: skip
        for name, values in fields.items():
            if values is not None:
                values.setflags(write=False)
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def length_m(self) -> float:
        """Length of the path from pose to pose, in metres."""
        return float(np.sum(np.linalg.norm(np.diff(self.position_m, axis=0), axis=1)))

    def replace(self, **changes: Any) -> "Trajectory":
        """Return a copy with some fields changed.

        Parameters
        ----------
        **changes
            New values of fields, by name.

        Raises
        ------
        ArgumentError
            There is no such field, or a value cannot be used.
        """
        return replaced("Trajectory", self, changes)

    def converted(self, pose_axes: PoseAxes) -> "Trajectory":
        """Return the poses of a platform, for poses of a frame with other axes.

        Parameters
        ----------
        pose_axes : {"platform", "camera", "camera-world", "ned"}
            Axes of this trajectory. "platform": x forward, y left, z up, which changes nothing. "camera": z forward, x
            right, y down, in a world whose z axis is up. "camera-world": the world has the axes of a camera as well, as
            in KITTI and in visual odometry whose world is its first camera. "ned": x forward, y right, z down, in a
            world of north, east and down, as on aircraft and vessels; the result has x north, y west, z up.

        Raises
        ------
        ArgumentError
            The axes are unknown.

        Examples
        --------
        >>> from ertis_numba import Trajectory
        >>> ahead = Trajectory([0, 1], [[0, 0, 0], [0, 0, 2]], [[0, 0, 0, 1]] * 2)
        >>> ahead.converted("camera-world").position_m.tolist()
        [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]
        """
        checks.choice("pose_axes", pose_axes, get_args(PoseAxes))
        rotation_xyzw, world = turned_axes(self.rotation_xyzw, pose_axes)
        covariance = self.covariance
        if covariance is not None:
            both = np.kron(np.eye(2), world)
            covariance = both @ covariance @ both.T
        return self.replace(position_m=self.position_m @ world.T, rotation_xyzw=rotation_xyzw, covariance=covariance)

    def at(self, time_ns: ArrayLike) -> "Trajectory":
        """Return the poses interpolated at other times.

        Positions and covariances are interpolated linearly, rotations along the shortest arc. Up to 1 ms before the
        first pose and after the last one, that pose applies, because the sensors of a pulse measure in succession.

        Parameters
        ----------
        time_ns : (n,) int64
            Strictly increasing times within the trajectory, in nanoseconds since 1970-01-01 UTC.

        Raises
        ------
        ArgumentError
            A time lies outside the trajectory, or the times do not increase.
        """
        wanted = _times("time_ns", time_ns)
        self._require_covered(wanted)
        index, fraction = self._brackets(wanted)
        covariance = None if self.covariance is None else _linear(self.covariance, index, fraction)
        position_m, rotation_xyzw = _linear(self.position_m, index, fraction), self._rotations(index, fraction)
        return Trajectory(wanted, position_m, rotation_xyzw, covariance, self.source, self.max_gap_s)

    def velocity_at(self, time_ns: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return linear and angular velocities by central differences between poses.

        At a pose, the difference spans the poses before and after it; between poses, velocities are interpolated
        linearly. At both ends, and beside an interval longer than `max_gap_s`, the difference is one-sided. Differences
        span no such interval, so the velocity at a pose between two of them is unknown.

        Parameters
        ----------
        time_ns : (n,) int64
            Times within the trajectory, in nanoseconds since 1970-01-01 UTC, in any order.

        Returns
        -------
        linear_m_s : (n, 3) float64
            Velocity in the world frame, in metres per second; NaN if it is unknown.
        angular_rad_s : (n, 3) float64
            Rotation vector per second, in the world frame, in radians per second; NaN if it is unknown.

        Raises
        ------
        ArgumentError
            A time lies outside the trajectory, or the trajectory has a single pose.

        Examples
        --------
        Poses at 0 s and 0.1 s have a velocity; the one at 5 s has none:

        >>> from ertis_numba import Trajectory
        >>> time_ns = [0, 100_000_000, 5_000_000_000]
        >>> path = Trajectory(time_ns, [[0, 0, 0], [0.1, 0, 0], [2, 0, 0]], [[0, 0, 0, 1]] * 3, max_gap_s=1.0)
        >>> path.velocity_at(time_ns)[0][:, 0].tolist()
        [1.0, 1.0, nan]
        """
        from scipy.spatial.transform import Rotation  # noqa: PLC0415  importing it takes longer than this package

        if len(self) == 1:
            raise ArgumentError("the trajectory has a single pose; a velocity needs at least 2")
        wanted = _times("time_ns", time_ns)
        self._require_covered(wanted)
        poses = np.arange(len(self))
        is_gap = self._gaps()
        before = poses - np.r_[False, ~is_gap[:-1]]
        after = poses + np.r_[~is_gap[:-1], False]
        duration_s = ((self.time_ns[after] - self.time_ns[before]) / _NS_PER_S)[:, None]
        duration_s[before == after] = np.nan
        linear_m_s = (self.position_m[after] - self.position_m[before]) / duration_s
        turns = Rotation.from_quat(self.rotation_xyzw[after]) * Rotation.from_quat(self.rotation_xyzw[before]).inv()
        index, fraction = self._brackets(wanted)
        # Within a long interval, only times next to a pose are covered, and the velocity of that pose applies.
        is_next = is_gap[index] & (fraction > 0.5)
        index, fraction = index + is_next, np.where(is_gap[index], 0.0, fraction)
        return _linear(linear_m_s, index, fraction), _linear(turns.as_rotvec() / duration_s, index, fraction)

    def covers(self, time_ns: ArrayLike) -> NDArray[np.bool_]:
        """Return True for times at which `at` returns a pose: (n,) bool.

        Parameters
        ----------
        time_ns : (n,) int64
        """
        wanted = _times("time_ns", time_ns)
        is_within = (wanted >= self.time_ns[0] - _MARGIN_NS) & (wanted <= self.time_ns[-1] + _MARGIN_NS)
        if self.max_gap_s is None:
            return np.asarray(is_within)
        before = np.clip(np.searchsorted(self.time_ns, wanted, side="right") - 1, 0, len(self) - 1)
        after = np.minimum(before + 1, len(self) - 1)
        nearest_ns = np.minimum(np.abs(wanted - self.time_ns[before]), np.abs(wanted - self.time_ns[after]))
        return np.asarray(is_within & (~self._gaps()[before] | (nearest_ns <= _MARGIN_NS)))

    def _gaps(self) -> NDArray[np.bool_]:
        """Return True for each pose that an interval without poses follows: (pose,) bool."""
        gaps = np.zeros(len(self), np.bool_)
        if self.max_gap_s is not None:
            gaps[:-1] = np.diff(self.time_ns) > self.max_gap_s * _NS_PER_S
        return gaps

    def _require_covered(self, wanted: NDArray[np.int64]) -> None:
        first, last = self.time_ns[0], self.time_ns[-1]
        outside = int(np.count_nonzero(~self.covers(wanted)))
        if outside:
            raise ArgumentError(
                f"{outside} of {len(wanted)} times from {_seconds(wanted.min())} to {_seconds(wanted.max())} lie "
                f"outside the trajectory, which covers {_seconds(first)} to {_seconds(last)}"
                f"{self._exception}; use times within it, or correct the clock offset"
            )

    @property
    def _exception(self) -> str:
        n_gaps = int(np.count_nonzero(self._gaps()))
        return f", except {counted(n_gaps, 'interval')} longer than {self.max_gap_s:g} s" if n_gaps else ""

    def _brackets(self, wanted: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return the index of the pose before each time, and the fraction of the way to the next one."""
        if len(self) == 1:
            return np.zeros(len(wanted), np.intp), np.zeros(len(wanted))
        index = np.clip(np.searchsorted(self.time_ns, wanted, side="right") - 1, 0, len(self) - 2)
        # Differences of integers come first, since float64 resolves only 256 ns of the time since 1970.
        fraction = (wanted - self.time_ns[index]) / (self.time_ns[index + 1] - self.time_ns[index])
        return index, np.clip(fraction, 0.0, 1.0)

    def _rotations(self, index: NDArray[np.intp], fraction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return quaternions between poses: the rotation to the next pose, scaled by the fraction of the way."""
        from scipy.spatial.transform import Rotation  # noqa: PLC0415  importing it takes longer than this package

        start = Rotation.from_quat(self.rotation_xyzw[index])
        end = Rotation.from_quat(self.rotation_xyzw[np.minimum(index + 1, len(self) - 1)])
        turn = Rotation.from_rotvec((start.inv() * end).as_rotvec() * fraction[:, None])
        rotation: NDArray[np.float64] = (start * turn).as_quat()
        for given, place in ((fraction == 0, index), (fraction == 1, index + 1)):  # These keep their bits.
            rotation[given] = self.rotation_xyzw[place[given]]
        return rotation


def _times(name: str, values: ArrayLike) -> NDArray[np.int64]:
    try:
        times = np.array(values)
    except ValueError as error:
        raise ArgumentError(f"{name} is not an array ({error}); pass one dimension of whole nanoseconds") from error
    if times.ndim != 1 or (times.size and times.dtype.kind not in "iu"):
        raise ArgumentError(
            f"{name} has shape {times.shape} and type {times.dtype}; pass one dimension of whole nanoseconds"
        )
    return times.astype(np.int64)


def _numbers(name: str, values: ArrayLike, wanted: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        numbers = np.array(values, np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name} is not an array of numbers ({error}); pass shape {wanted}") from error
    checks.shape(name, numbers.shape, wanted)
    checks.finite_array(name, numbers)
    return numbers


def _covariances(values: ArrayLike, n_poses: int) -> NDArray[np.float64]:
    """Return checked covariances: (pose, 6, 6) float64."""
    covariance = _numbers("covariance", values, (n_poses, 6, 6))
    largest = float(np.max(np.abs(covariance)))
    if largest > _MAX_POSITION_M**2:
        raise ArgumentError(f"covariance reaches {largest:g}; pass square metres up to {_MAX_POSITION_M**2:g}")
    tolerance = _MAX_ASYMMETRY * np.max(np.abs(covariance), axis=(1, 2))
    uneven = np.max(np.abs(covariance - covariance.transpose(0, 2, 1)), axis=(1, 2)) > tolerance
    if uneven.any():
        raise ArgumentError(f"covariance is not symmetric at [{np.argmax(uneven)}]; use covariances of pose errors")
    negative = np.linalg.eigvalsh(covariance)[:, 0] < -tolerance
    if negative.any():
        raise ArgumentError(
            f"covariance has a negative eigenvalue at [{np.argmax(negative)}]; use positive semidefinite matrices"
        )
    return covariance


def _linear(values: NDArray[np.float64], index: NDArray[np.intp], fraction: NDArray[np.float64]) -> NDArray[np.float64]:
    weight = fraction.reshape(-1, *[1] * (values.ndim - 1))
    following = np.minimum(index + 1, len(values) - 1)
    linear = values[index] * (1 - weight) + values[following] * weight
    return np.where(weight == 0, values[index], linear)  # Otherwise, 0 × NaN would make a neighbour unknown.


def _seconds(time_ns: np.int64) -> str:
    whole, rest = divmod(int(time_ns), 10**9)
    return f"{whole}.{rest // 10**6:03d} s"
