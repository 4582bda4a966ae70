"""Poses of platforms in a journal."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from ertis_numba.base.errors import DamagedError
from ertis_numba.frames import Trajectory
from ertis_numba.journal._database import Database
from ertis_numba.journal._entries import verified_values
from ertis_numba.journal._tables import POSES, select_statement

__all__ = ["JournalPose", "PosesAround", "pose_blocks", "read_poses", "trajectory_through"]

_SEPARATOR: Final = ","  # Names of sensors contain none.
_MAX_SOURCE_BYTES: Final = 1024  # Limit of a recording.
_BLOCK: Final = 10_000  # Number of rows read at a time, which take some 10 MB.
_ROW_BYTES: Final = 100  # Numbers, checksum and index of a row: 91 to 102 bytes were measured.


@dataclass(frozen=True, slots=True)
class JournalPose:
    """Pose of a platform in the world frame at a time since 1970-01-01 UTC, for the measurements of the sensors on it.

    ``covariance`` has 6 by 6 little-endian doubles, as in `Trajectory`; it is empty if unknown.
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
        """Return the pose of a row."""
        names, time_ns, *numbers, covariance, source = verified_values(path, "a pose", row)
        kinds = (isinstance(names, str), isinstance(source, str), isinstance(covariance, bytes))
        if not (all(kinds) and isinstance(time_ns, int) and all(isinstance(each, float) for each in numbers)):
            raise DamagedError(f"{path}: a pose has a value of a wrong type; copy the journal again if you can")
        return cls(tuple(names.split(_SEPARATOR)), time_ns, tuple(numbers[:3]), tuple(numbers[3:]), covariance, source)


def pose_blocks(
    database: Database, path: Path, *, after: int = 0, n_max: int = _BLOCK
) -> Iterator[tuple[list[JournalPose], int]]:
    """Yield blocks of up to ``n_max`` poses after row ``after``: the undamaged ones, and the number of damaged ones."""
    if not database.has_table(POSES):
        return
    statement = select_statement(POSES, "WHERE id > ? ORDER BY id LIMIT ?")
    while rows := database.execute(statement, (after, n_max)):
        if rows[-1][0] <= after:
            raise DamagedError(f"{path} is damaged: its poses are out of order; copy it again if you can")
        after = rows[-1][0]
        poses = []
        for row in rows:
            with suppress(DamagedError):
                poses.append(JournalPose.from_row(path, row))
        yield poses, len(rows) - len(poses)


def read_poses(database: Database, path: Path, *, after: int = 0) -> tuple[list[JournalPose], int]:
    """Return all undamaged poses and the number of damaged ones; parameters and errors as for `pose_blocks`."""
    blocks = list(pose_blocks(database, path, after=after))
    return [pose for poses, _ in blocks for pose in poses], sum(n_damaged for _, n_damaged in blocks)


def trajectory_through(poses: Sequence[JournalPose], *, max_gap_s: float) -> Trajectory:
    """Return the trajectory through poses of one platform in any order; of several poses at one time, the first counts.

    The covariance is None if that of any pose is unknown. An impossible pose raises ArgumentError or ValueError.
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
        _joined(pose.source for pose in kept),
        max_gap_s,
    )


class PosesAround:
    """First and last pose between two given times, so that memory depends on the number of times only."""

    def __init__(self, time_ns: ArrayLike, *, max_gap_s: float) -> None:
        self._wanted_ns = np.unique(np.asarray(time_ns, np.int64))
        self._max_gap_s = max_gap_s
        self._kept: Trajectory | None = None
        self._waiting: list[Trajectory] = []
        self._n_waiting = 0
        self._sources: dict[str, None] = {}

    def add(self, poses: Sequence[JournalPose]) -> None:
        """Add poses in any order, the first of each time; raise ArgumentError or ValueError for an impossible one."""
        if not poses:
            return
        self._waiting.append(trajectory_through(poses, max_gap_s=self._max_gap_s))
        self._n_waiting += len(poses)
        if sum(map(len, self._sources)) < _MAX_SOURCE_BYTES:
            self._sources |= dict.fromkeys(pose.source for pose in poses)
        if self._n_waiting > (0 if self._kept is None else len(self._kept)):  # Each pose is sorted only a few times.
            self._choose()

    def trajectory(self) -> Trajectory | None:
        """Return the trajectory through the poses around the times; None without poses."""
        self._choose()
        return None if self._kept is None else self._kept.replace(source=_joined(self._sources))

    def _choose(self) -> None:
        """Keep the poses before and after each time, and those at both ends."""
        parts = [*([] if self._kept is None else [self._kept]), *self._waiting]
        if not parts:
            return
        self._waiting, self._n_waiting = [], 0
        time_ns, first = np.unique(np.concatenate([part.time_ns for part in parts]), return_index=True)
        after = np.searchsorted(self._wanted_ns, time_ns)  # Number of times before each pose.
        is_empty = after[1:] == np.searchsorted(self._wanted_ns, time_ns[:-1])
        is_kept = np.ones(len(time_ns), np.bool_)
        is_kept[1:-1] = ~(is_empty[:-1] & is_empty[1:])
        chosen = first[is_kept]
        covariances = [part.covariance for part in parts if part.covariance is not None]
        self._kept = Trajectory(
            time_ns[is_kept],
            np.concatenate([part.position_m for part in parts])[chosen],
            np.concatenate([part.rotation_xyzw for part in parts])[chosen],
            np.concatenate(covariances)[chosen] if len(covariances) == len(parts) else None,
            "",
            self._max_gap_s,
        )


def _joined(sources: Iterable[str]) -> str:
    """Return the names of several sources as one."""
    return ", ".join(dict.fromkeys(sources)).encode()[:_MAX_SOURCE_BYTES].decode(errors="ignore")
