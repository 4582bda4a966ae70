"""Odometry of groups of images that arrive live: mountings may change, and clocks may be set."""

import time
from collections.abc import Callable, Mapping
from typing import Final

from ertis_numba.frames import Trajectory
from ertis_numba.fusion.rig import Mountings
from ertis_numba.motion.odometry import Odometry
from ertis_numba.motion.planar_pose import PlanarPose
from ertis_numba.motion.velocity import EgoVelocity, Item, stamp_of

__all__ = ["LiveOdometry"]

_RESTART_S: Final = 1.0


class LiveOdometry:
    """Odometry that continues where recordings would be refused; on_note gets a line per unusable group."""

    def __init__(self, on_note: Callable[[str], None], *, alone: bool | None = None) -> None:
        self._note, self._alone = on_note, alone
        self._mountings: Mountings = {}
        self._first: frozenset[str] = frozenset()  # Sensors of the first group.
        self._odometry: Odometry | None = None
        self._early_s: float | None = None  # Time of the first of the latest pulses, all of which were left out.

    @property
    def trajectory(self) -> Trajectory | None:
        """Poses at all groups so far; None before the first group."""
        return self._odometry.trajectory if self._odometry is not None and self._odometry.poses else None

    def add(self, group: Mapping[str, Item], mountings: Mountings) -> tuple[PlanarPose, EgoVelocity | None] | None:
        """Return pose and velocity at a group as `Odometry.add` does; None if it is not later than the last one."""
        # An application may connect during a pulse, so the path begins with the second group if that has more sensors.
        if self._has_restarted(group):
            self._odometry = None
        is_second = self._odometry is not None and len(self._odometry.poses) == 1
        if self._odometry is None or (is_second and group.keys() - self._first):
            self._odometry, self._first = Odometry(mountings, alone=self._alone), frozenset(group)
        elif mountings != self._mountings:
            self._odometry.remount(mountings)
        self._mountings = dict(mountings)
        early_s = self._early_s_of(group)
        if early_s is not None:
            self._note(
                f"SYNC pulse {stamp_of(group).sync_count} is left out: it is {early_s:.3g} s before the last one; was "
                "a clock set back?"
            )
            return None
        self._early_s = None
        velocity = self._odometry.add(group.values())
        return self._odometry.poses[-1], velocity

    def _early_s_of(self, group: Mapping[str, Item]) -> float | None:
        """Return the time of a group before the last pose; None if it is later."""
        poses = self._odometry.poses if self._odometry is not None else ()
        if self._odometry is None or not poses or self._odometry.time_ns_of(group) > poses[-1].timestamp_ns:
            return None
        return (poses[-1].timestamp_ns - self._odometry.time_ns_of(group)) / 1e9

    def _has_restarted(self, group: Mapping[str, Item]) -> bool:
        """Return True if all pulses have been before the last one for a second: their clock was set back."""
        if self._early_s_of(group) is None:
            self._early_s = None
            return False
        now_s = time.monotonic()
        self._early_s = now_s if self._early_s is None else self._early_s
        if now_s - self._early_s < _RESTART_S:
            return False
        self._note("the clock of the sensors was set back; the path begins anew at the origin")
        return True
