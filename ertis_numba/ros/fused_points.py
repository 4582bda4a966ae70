"""Points of all sensors that emitted together, in the frame of their platform."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from ertis_numba.frames import PointCloud
from ertis_numba.fusion.pulses import PulseGroups

__all__ = ["FusedPoints", "joined"]

PLATFORM_FRAME: Final = "base_link"


class FusedPoints:
    """Collector of the points of each SYNC pulse, joined in the frame of the platform."""

    def __init__(self) -> None:
        self._groups: PulseGroups[PointCloud] = PulseGroups()

    def add(self, cloud: PointCloud) -> list[PointCloud]:
        """Add the points of a sensor with a known mounting, and return the groups that are complete now, joined.

        Points that come after their group was returned are left out.
        """
        return [joined(group) for group in self._groups.add(cloud)]


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
