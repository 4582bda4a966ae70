"""Recent poses, which several journals need: measurements at both ends of a journal lie between two poses."""

import collections
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from ertis_numba.errors import DataError
from ertis_numba.journal import Journal, JournalPose
from ertis_numba.network.central_node._volumes import Volume

__all__ = ["RecentPoses"]

_INTERVAL_S: Final = 0.5
"""Interval of commits of poses; a crash may lose the poses since the last one."""

_LATE_S: Final = 2.0
"""Time after the end of a journal in which poses of its measurements may still arrive."""

_KEPT_S: Final = 5.0
_MAX_KEPT: Final = 20_000  # Takes about 15 MB.


class RecentPoses:
    """Poses of the last seconds, and the journals that wait for later ones."""

    def __init__(self) -> None:
        self._kept: collections.deque[tuple[int, float, JournalPose]] = collections.deque(maxlen=_MAX_KEPT)
        self._next_number = 1
        self._tried_s = -_INTERVAL_S
        self._late: dict[Path, tuple[int, float]] = {}  # First number that a journal lacks, and the end of its wait.

    def add(self, poses: Iterable[JournalPose], volume: Volume | None) -> None:
        """Add poses that have arrived, and discard old ones that the journal in use contains."""
        now_s = time.monotonic()
        for pose in poses:
            self._kept.append((self._next_number, now_s, pose))
            self._next_number += 1
        needed = self._next_number if volume is None else volume.next_pose
        while self._kept and self._kept[0][1] < now_s - _KEPT_S and self._kept[0][0] < needed:
            self._kept.popleft()

    def is_due(self, volume: Volume) -> bool:
        """Return True if the journal in use lacks poses, and the last call of `store` was an interval ago."""
        has_more = bool(self._kept) and self._kept[-1][0] >= volume.next_pose
        return has_more and time.monotonic() - self._tried_s >= _INTERVAL_S

    def store(self, volume: Volume) -> None:
        """Store the poses that a journal lacks; see `Journal.append_poses`."""
        self._tried_s = time.monotonic()
        lacking = list(self._from(volume.next_pose))
        if lacking:
            volume.append_poses(lacking)
            volume.next_pose = self._next_number

    def retire(self, volume: Volume) -> None:
        """Let a finished journal wait for the poses after its last measurements if some arrived recently."""
        now_s = time.monotonic()
        if self._kept and now_s - self._kept[-1][1] < _LATE_S:
            self._late[volume.path] = volume.next_pose, now_s + _LATE_S

    def waits(self, path: Path) -> bool:
        """Return True if a finished journal still waits for poses."""
        return path in self._late and time.monotonic() < self._late[path][1]

    def hurry(self) -> None:
        """End the wait of all finished journals: no pose will follow."""
        self._late = {path: (number, 0.0) for path, (number, _) in self._late.items()}

    def complete(self, path: Path) -> None:
        """Store the poses that have arrived since a journal was finished; errors are ignored."""
        number, _ = self._late.pop(path, (self._next_number, 0.0))
        lacking = list(self._from(number))
        if lacking:
            with suppress(DataError, OSError), Journal.open(path) as journal:  # Measurements matter more than poses.
                journal.append_poses(lacking)

    def _from(self, number: int) -> Iterator[JournalPose]:
        return (pose for other, _, pose in self._kept if other >= number)
