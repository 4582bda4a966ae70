"""Poses of the platform as variables of a sensor's group: one pose per measurement."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError, DamagedError
from ertis_numba.frames import Trajectory
from ertis_numba.storage.schema import POSES
from ertis_numba.storage.structure import MAX_TEXT_BYTES, local_member
from ertis_numba.storage.variables import create_variables

__all__ = [
    "MAX_GAP_S",
    "POSE_SIZES",
    "Poses",
    "checked_poses",
    "poses_of",
    "read_poses",
    "remove_poses",
    "require_times",
    "write_poses",
]

POSE_SIZES: Final = {"axis": 3, "quaternion": 4, "pose_row": 6, "pose_column": 6}
"""Lengths of the axes of poses."""

Poses = Trajectory | Mapping[str, Trajectory]
"""Trajectory of the platform, or of the platform of each sensor, by name of the sensor."""

MAX_GAP_S: Final = 1.0
"""Longest interval between poses over which those of a file with holes are interpolated."""

_AXES_OF_POSES: Final = ("quaternion", "pose_row", "pose_column")
_MAX_SOURCE_BYTES: Final = MAX_TEXT_BYTES["pose_source"]


def checked_poses(poses: object) -> Poses | None:
    """Return poses, after a check of their type and source."""
    if poses is None:
        return None
    several: Iterable[Any] = poses.values() if isinstance(poses, Mapping) else (poses,)
    for each in several:
        if not isinstance(each, Trajectory):
            raise ArgumentError(
                f"poses are of type {type(each).__name__}; pass a Trajectory, or a dictionary with a Trajectory for "
                "each sensor"
            )
        if len(each.source.encode()) > _MAX_SOURCE_BYTES:
            raise ArgumentError(
                f"the source of poses has {len(each.source.encode())} bytes; the limit is {_MAX_SOURCE_BYTES}; shorten "
                "it (Trajectory.replace)"
            )
    return poses  # type: ignore[return-value]  # checked above


def poses_of(poses: Poses | None, sensor: str) -> Trajectory | None:
    """Return the trajectory of a sensor's platform; None if it is unknown."""
    return poses.get(sensor) if isinstance(poses, Mapping) else poses


def require_times(trajectory: Trajectory, time_ns: NDArray[np.int64], sensor: str) -> None:
    """Refuse measurements outside a trajectory, unless it may have gaps."""
    if not len(time_ns) or trajectory.max_gap_s is not None:
        return
    first_ns, last_ns = int(trajectory.time_ns[0]), int(trajectory.time_ns[-1])
    begin_ns, end_ns = int(time_ns.min()), int(time_ns.max())
    if trajectory.covers(time_ns).all():
        return
    if not np.any(time_ns):
        raise ArgumentError(
            f"the times of the measurements of sensor {sensor} are unknown; poses need measurements with times"
        )
    raise ArgumentError(
        f"the poses cover {_span(first_ns, last_ns)}, but the measurements of sensor {sensor} cover "
        f"{_span(begin_ns, end_ns)}; use poses of this time, or correct the offset of their clock (offset_s)"
    )


def write_poses(group: h5py.Group, trajectory: Trajectory) -> None:
    """Store the pose at each measurement of a sensor, if any; NaN where `max_gap_s` of the trajectory leaves none."""
    time_ns = np.asarray(group["time"][:], np.int64)
    require_times(trajectory, time_ns, group.name.rpartition("/")[2])
    times, rows = np.unique(time_ns, return_inverse=True)  # Measurements may be out of order, or share a time.
    is_covered = trajectory.covers(times)
    if not is_covered.any():
        return
    if "axis" in group:  # That of positions; files of images may have none.
        local_member(group, "axis", h5py.Dataset)
    stored = trajectory.at(times[is_covered])
    columns = {"pose_position": stored.position_m, "pose_rotation": stored.rotation_xyzw}
    if stored.covariance is not None:
        columns["pose_covariance"] = stored.covariance
    table = [variable for variable in POSES if variable.name in {*columns, "pose_source"}]
    create_variables(group, table, sizes=POSE_SIZES, texts={"pose_source": trajectory.source})
    for name, values in columns.items():
        variable = group[name]
        variable.resize(len(time_ns), axis=0)
        column = np.full((len(times), *values.shape[1:]), np.nan)
        column[is_covered] = values
        variable[:] = column[rows]
        variable.flush()


def read_poses(group: h5py.Group, path: Path) -> Trajectory | None:
    """Return the poses at the measurements of a sensor, by increasing time; None if there are none."""
    found = [name for name in ("pose_position", "pose_rotation", "pose_source") if name in group]
    if not found:
        return None
    sensor = group.name.rpartition("/")[2]
    if len(found) < 3:
        raise DamagedError(f"{path} has {found[0]!r} for sensor {sensor}, but not all of its poses; copy it again")
    times, rows = np.unique(group["time"][:].astype(np.int64), return_index=True)
    columns = [group[name][:][rows] for name in (*found[:2], "pose_covariance") if name in group]
    is_pose = ~np.all([np.isnan(column.reshape(len(times), -1)).all(axis=1) for column in columns], axis=0)
    if not is_pose.any():
        return None
    position_m, rotation_xyzw, *covariances = (column[is_pose] for column in columns)
    source = group["pose_source"][()].decode(errors="replace")
    max_gap_s = None if is_pose.all() else MAX_GAP_S
    try:
        covariance = covariances[0] if covariances else None
        return Trajectory(times[is_pose], position_m, rotation_xyzw, covariance, source, max_gap_s)
    except ArgumentError as error:
        problem = str(error).partition(";")[0]
        raise DamagedError(f"{path}: the poses of sensor {sensor} are damaged ({problem}); copy it again") from error


def remove_poses(group: h5py.Group) -> None:
    """Remove the poses of a sensor, and the axes that only they have."""
    poses = [variable.name for variable in POSES]
    for name in poses:
        if name in group:
            for axis in group[name].dims:
                for scale in axis.values():
                    axis.detach_scale(scale)
    for name in {*poses, *_AXES_OF_POSES}.intersection(group):  # This includes broken links.
        del group[name]


def _span(first_ns: int, last_ns: int) -> str:
    return f"{_seconds(first_ns)} to {_seconds(last_ns)} s"


def _seconds(time_ns: int) -> str:
    whole, rest = divmod(time_ns, 10**9)
    return f"{whole}.{rest // 10**6:03d}"
