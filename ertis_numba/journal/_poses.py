"""Poses of platforms in a journal."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from ertis_numba.errors import DamagedError
from ertis_numba.frames import Trajectory
from ertis_numba.journal._database import Database
from ertis_numba.journal._entries import verified_values
from ertis_numba.journal._tables import POSES, select_statement

__all__ = ["JournalPose", "read_poses", "trajectory_through"]

_SEPARATOR: Final = ","  # Names of sensors contain none.
_MAX_SOURCE_BYTES: Final = 1024  # Limit of a recording.
_ROW_BYTES: Final = 100  # Numbers, checksum and index of a row: 91 to 102 bytes were measured.


@dataclass(frozen=True, slots=True)
class JournalPose:
    """Pose of a platform, for the measurements of the sensors on it.

    Attributes
    ----------
    sensors : tuple of str
        Names of the sensors on the platform.
    timestamp_ns : int
        Time in nanoseconds since 1970-01-01 UTC.
    position_m : tuple of 3 float
        Position of the platform in the world frame.
    rotation_xyzw : tuple of 4 float
        Unit quaternion that rotates the platform frame into the world frame.
    covariance : bytes
        6 by 6 doubles, little-endian: the covariance, as in `Trajectory`. Empty if it is unknown.
    source : str
        Origin of the pose.
    """

    sensors: tuple[str, ...]
    timestamp_ns: int
    position_m: tuple[float, ...]
    rotation_xyzw: tuple[float, ...]
    covariance: bytes = b""
    source: str = ""

    @property
    def n_bytes(self) -> int:
        """Approximate size in a journal."""
        texts = (_SEPARATOR.join(self.sensors), self.source)
        return _ROW_BYTES + len(self.covariance) + sum(len(text.encode()) for text in texts)

    def row(self) -> tuple[Any, ...]:
        """Return the row of the pose in a journal, without id and checksum."""
        numbers = map(float, (*self.position_m, *self.rotation_xyzw))
        return _SEPARATOR.join(self.sensors), self.timestamp_ns, *numbers, self.covariance, self.source

    @classmethod
    def from_row(cls, path: Path, row: Sequence[Any]) -> Self:
        """Return the pose of a row.

        Raises
        ------
        DamagedError
            The row does not match its checksum, or is not that of a pose.
        """
        names, time_ns, *numbers, covariance, source = verified_values(path, "a pose", row)
        kinds = (isinstance(names, str), isinstance(source, str), isinstance(covariance, bytes))
        if not (all(kinds) and isinstance(time_ns, int) and all(isinstance(each, float) for each in numbers)):
            raise DamagedError(f"{path}: a pose has a value of a wrong type; copy the journal again if you can")
        return cls(tuple(names.split(_SEPARATOR)), time_ns, tuple(numbers[:3]), tuple(numbers[3:]), covariance, source)


def read_poses(database: Database, path: Path, *, after: int = 0) -> tuple[list[JournalPose], int]:
    """Return the undamaged poses of a journal in order of arrival, and the number of damaged ones.

    Parameters
    ----------
    database : Database
        Tables of the journal.
    path : Path
        Path of the journal.
    after : int
        Number of the last row to leave out.

    Raises
    ------
    DamagedError
        The table is damaged.
    """
    poses: list[JournalPose] = []
    n_damaged = 0
    if database.has_table(POSES):
        for row in database.execute(select_statement(POSES, "WHERE id > ? ORDER BY id"), (after,)):
            try:
                poses.append(JournalPose.from_row(path, row))
            except DamagedError:
                n_damaged += 1
    return poses, n_damaged


def trajectory_through(poses: Sequence[JournalPose], *, max_gap_s: float) -> Trajectory:
    """Return the trajectory through poses; of several poses at one time, the first counts.

    The covariance is None if that of any pose is unknown. The source lists the sources of the poses.

    Parameters
    ----------
    poses : sequence of JournalPose
        Poses of one platform in any order, at least one.
    max_gap_s : float
        Longest interval of the trajectory between poses.

    Raises
    ------
    ArgumentError, ValueError
        A number or a covariance cannot be that of a pose.
    """
    time_ns, first = np.unique([pose.timestamp_ns for pose in poses], return_index=True)
    kept = [poses[index] for index in first]
    covariances = np.frombuffer(b"".join(pose.covariance for pose in kept), "<f8")
    is_known = all(pose.covariance for pose in kept)
    return Trajectory(
        time_ns,
        np.array([pose.position_m for pose in kept]),
        np.array([pose.rotation_xyzw for pose in kept]),
        covariances.reshape(len(kept), 6, 6) if is_known else None,
        ", ".join(dict.fromkeys(pose.source for pose in kept)).encode()[:_MAX_SOURCE_BYTES].decode(errors="ignore"),
        max_gap_s,
    )
