"""Recent poses, which several journals need: measurements at both ends of a journal lie between two poses."""

import collections
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from ertis_numba.base.errors import DataError
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
        # First number that a journal lacks, sensors of which it has the earlier poses, and the end of its wait.
        self._late: dict[Path, tuple[int, frozenset[str], float]] = {}

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
        if not self._kept:
            return False
        has_more = self._kept[-1][0] >= volume.next_pose or volume.posed != frozenset(volume.journal.sensors)
        return has_more and time.monotonic() - self._tried_s >= _INTERVAL_S

    def store(self, volume: Volume) -> None:
        """Store the poses of its sensors that a journal lacks; see `Journal.append_poses`."""
        self._tried_s = time.monotonic()
        known = frozenset(volume.journal.sensors)
        lacking = list(self._lacking(volume.next_pose, volume.posed, known))
        if lacking:
            volume.append_poses(lacking)
        volume.next_pose, volume.posed = self._next_number, known

    def _lacking(self, number: int, posed: frozenset[str], known: frozenset[str]) -> Iterator[JournalPose]:
        """Yield the poses of known sensors, except those before a number that a journal has of the ``posed`` ones."""
        for other, _, pose in self._kept:
            if not known.isdisjoint(pose.sensors) and (other >= number or posed.isdisjoint(pose.sensors)):
                yield pose

    def retire(self, volume: Volume) -> None:
        """Let a finished journal wait for the poses after its last measurements if some arrived recently."""
        now_s = time.monotonic()
        if self._kept and now_s - self._kept[-1][1] < _LATE_S:
            self._late[volume.path] = volume.next_pose, volume.posed, now_s + _LATE_S

    def waits(self, path: Path) -> bool:
        """Return True if a finished journal still waits for poses."""
        return path in self._late and time.monotonic() < self._late[path][-1]

    def hurry(self) -> None:
        """End the wait of all finished journals: no pose will follow."""
        self._late = {path: (number, posed, 0.0) for path, (number, posed, _) in self._late.items()}

    def complete(self, path: Path) -> None:
        """Store the poses that have arrived since a journal was finished; errors are ignored."""
        if path not in self._late:
            return
        number, posed, _ = self._late.pop(path)
        with suppress(DataError, OSError), Journal.open(path) as journal:  # Measurements matter more than poses.
            lacking = list(self._lacking(number, posed, frozenset(journal.sensors)))
            if lacking:
                journal.append_poses(lacking)
