"""Points of several measurements as one table."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape, PointCloud, Stamp
from ertis_numba.interop._mountings import PLATFORM, Mountings

__all__ = ["FindPoints", "PointTable", "ros_time"]

FindPoints: TypeAlias = Callable[[Energyscape], PointCloud]
"""Function that returns the points of an image, in the sensor frame."""

_POINT: Final = np.dtype(
    [
        *((name, "<f8") for name in "xyz"),
        *((name, "<f4") for name in ("intensity", "uncertainty_range", "uncertainty_across")),
        ("sensor", "<u2"),
        *((name, "<i8") for name in ("session_id", "sequence", "sync_count", "timestamp_ns")),
    ]
)
_NS = 1_000_000_000
_MAX_ROUNDING_M: Final = 1e-5
_MAX_SEC = 2**31 - 1


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """Points of several measurements, one row each."""

    rows: NDArray[np.void]  # (point,) position and uncertainty in m, intensity, number of the sensor, and stamp
    sensors: tuple[str, ...]  # names by number
    frame: str  # of the positions: the platform if mountings are known, otherwise the only sensor

    @property
    def fits_float32(self) -> bool:
        """Return True if float32 rounds no position by more than 10 µm, which holds up to 168 m from the origin."""
        return all(
            np.abs(self.rows[axis] - self.rows[axis].astype(np.float32)).max(initial=0.0) <= _MAX_ROUNDING_M
            for axis in "xyz"
        )

    @classmethod
    def from_images(cls, images: Iterable[Energyscape], find: FindPoints, mountings: Mountings) -> "PointTable":
        """Collect the points of images; with several sensors, all mountings must be known."""
        numbers: dict[str, int] = {}
        parts = [np.empty(0, _POINT)]
        for image in images:
            sensor = image.stamp.sensor
            parts.append(_rows(find(image), numbers.setdefault(sensor, len(numbers)), mountings))
            frames = {PLATFORM if name in mountings else name for name in numbers}
            if len(frames) > 1:
                raise ArgumentError(
                    f"the mountings of sensors {', '.join(numbers)} on their platform are unknown, but all "
                    "points need one frame; choose one sensor (sensor), or add their mountings "
                    "(mountings)"
                )
        frame = PLATFORM if numbers.keys() & mountings.keys() else next(iter(numbers), PLATFORM)
        return cls(np.concatenate(parts), tuple(numbers), frame)

    def columns(self, dtypes: dict[str, str]) -> NDArray[np.void]:
        """Return some columns, packed, in the types of a format; sec and nanosec are the time as in ROS 2."""
        made = np.empty(len(self.rows), np.dtype(list(dtypes.items())))
        times = self._ros_times() if {"sec", "nanosec"} & dtypes.keys() else {}
        for name, dtype in dtypes.items():
            column: NDArray[Any] = times[name] if name in times else self.rows[name]
            made[name] = column.astype(dtype)
            if column.dtype.kind != "f" and not np.array_equal(made[name], column):
                raise ArgumentError(
                    f"{name} of a measurement is {column.max()}, above the limit of the format; use csv"
                )
        return made

    def _ros_times(self) -> dict[str, NDArray[np.int64]]:
        sec, nanosec = np.divmod(self.rows["timestamp_ns"], _NS)
        beyond = self.rows[(sec < 0) | (sec > _MAX_SEC)]
        if len(beyond):
            raise _no_ros_time(beyond["sequence"][0], beyond["timestamp_ns"][0])
        return {"sec": sec, "nanosec": nanosec}


def _rows(cloud: PointCloud, number: int, mountings: Mountings) -> NDArray[np.void]:
    stamp = cloud.stamp
    made = np.empty(len(cloud), _POINT)
    if stamp.sensor in mountings:
        translation_m, rotation_xyzw = mountings[stamp.sensor]
        cloud = cloud.replace(translation_m=translation_m, rotation_xyzw=rotation_xyzw)
        position_m = cloud.on_platform_m()
    else:
        position_m = cloud.position_m.astype(np.float64)
    made["x"], made["y"], made["z"] = position_m.T
    made["intensity"] = cloud.amplitude
    unknown_m = np.full((len(cloud), 2), np.nan, dtype=np.float32)
    uncertainty_m = unknown_m if cloud.uncertainty_m is None else cloud.uncertainty_m
    made["uncertainty_range"], made["uncertainty_across"] = uncertainty_m.T
    made["sensor"] = number
    for name in ("session_id", "sequence", "sync_count", "timestamp_ns"):
        made[name] = getattr(stamp, name)
    return made


def ros_time(stamp: Stamp) -> tuple[int, int]:
    """Return the time of a measurement, from 1970 to 2038, as seconds and nanoseconds (builtin_interfaces/msg/Time)."""
    sec, nanosec = divmod(stamp.timestamp_ns, _NS)
    if not 0 <= sec <= _MAX_SEC:
        raise _no_ros_time(stamp.sequence, stamp.timestamp_ns)
    return sec, nanosec


def _no_ros_time(sequence: int, timestamp_ns: int) -> ArgumentError:
    return ArgumentError(f"measurement {sequence} has the time {timestamp_ns} ns, outside 1970 to 2038; use npz or csv")
