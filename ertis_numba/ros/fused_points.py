"""Points of all sensors that emitted together, in the frame of their platform."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from ertis_numba.frames import PointCloud, Stamp

__all__ = ["FusedPoints", "joined"]

PLATFORM_FRAME: Final = "base_link"
_SAME_PULSE_NS: Final = 500_000_000  # Counts of different captures may be equal by accident.


@dataclass(slots=True)
class FusedPoints:
    """Collector of the points of each SYNC pulse.

    A group is complete once it has points of all sensors of the group before, and of sensors that have come since. Of
    a sensor that is missing, the next group shows that no more will come.
    """

    _expected: set[str] = field(default_factory=set)
    _group: dict[str, PointCloud] = field(default_factory=dict)
    _closed: Stamp | None = None  # Stamp of the group that was returned last.

    def add(self, cloud: PointCloud) -> list[PointCloud]:
        """Add the points of a sensor with a known mounting, and return the groups that are complete now, joined.

        Points that come after their group was returned are left out.
        """
        done = []
        if self._group and not self._belongs(cloud):
            done.append(self._close())
        sensor = cloud.stamp.sensor
        is_late = self._closed is not None and _is_same_pulse(cloud.stamp, self._closed) and not self._group
        self._expected.add(sensor)
        if not is_late:
            self._group[sensor] = cloud
            if self._group.keys() >= self._expected:
                done.append(self._close())
        return done

    def _belongs(self, cloud: PointCloud) -> bool:
        other = next(iter(self._group.values())).stamp
        return cloud.stamp.sensor not in self._group and _is_same_pulse(cloud.stamp, other)

    def _close(self) -> PointCloud:
        group, self._group = self._group, {}
        self._expected = set(group)
        self._closed = next(iter(group.values())).stamp
        return joined(group)


def _is_same_pulse(one: Stamp, other: Stamp) -> bool:
    return one.sync_count == other.sync_count and abs(one.timestamp_ns - other.timestamp_ns) < _SAME_PULSE_NS


def joined(clouds: Mapping[str, PointCloud]) -> PointCloud:
    """Return the points of several sensors as one cloud in the frame of the platform, with the earliest time.

    Parameters
    ----------
    clouds : mapping of str to PointCloud
        Points by sensor, with known mountings.
    """
    each = list(clouds.values())
    stamp = min((cloud.stamp for cloud in each), key=lambda stamp: stamp.timestamp_ns)
    uncertainty_m = [
        np.full((len(cloud), 2), np.nan, np.float32) if cloud.uncertainty_m is None else cloud.uncertainty_m
        for cloud in each
    ]
    return each[0].replace(
        position_m=np.concatenate([cloud.on_platform_m() for cloud in each]),
        amplitude=np.concatenate([cloud.amplitude for cloud in each]),
        uncertainty_m=np.concatenate(uncertainty_m),
        stamp=replace(stamp, sensor=PLATFORM_FRAME),
        translation_m=(0.0, 0.0, 0.0),
        rotation_xyzw=(0.0, 0.0, 0.0, 1.0),
    )
