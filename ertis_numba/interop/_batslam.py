"""Data sets for BatSLAM 2.0 (https://github.com/Cosys-Lab/BatSLAM2): binaural echoes, poses and odometry.

``docs/reference/batslam-format.md`` describes each field.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Measurement, Trajectory
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.interop._drive import Drive
from ertis_numba.interop._mountings import Mounting, Mountings
from ertis_numba.interop._virtual_ears import VirtualEars
from ertis_numba.simulation import Scene
from ertis_numba.simulation.targets import Wall

__all__ = ["noise_model", "write_batslam"]

Floats = NDArray[np.float64]

_FULL_SCALE: Final = 32767
_MAX_BYTES: Final = 2**31 - 1  # per variable of a MATLAB v7 file
_NS_PER_S: Final = 1e9
_UPRIGHT: Final = 0.7  # Largest vertical component of the normal of a wall in a plan.


def write_batslam(path: Path, measurements: Iterable[Measurement], drive: Drive, mountings: Mountings) -> None:
    """Write the measurements of one sensor in order of time; without a mounting, it is at the platform's origin."""
    echoes = _EchoRows.of(measurements, drive.beam_azimuth_deg)
    true, measured = (
        _planar(_at(trajectory, echoes.time_ns, name), mountings.get(echoes.sensor))
        for trajectory, name in ((drive.poses, "poses"), (drive.odometry, "odometry"))
    )
    gt_delta, odom_delta = _deltas(true), _deltas(measured)
    ears = echoes.ears
    meta = {
        "fs": ears.rate_hz,
        "speed_of_sound": sound_speed_m_s(ears.settings.air),
        "call": ears.call[None, :],
        "max_range": ears.max_range_m,
        **noise_model(gt_delta, odom_delta),
        "lap_names": np.array([f"session {number}" for number in range(1, int(echoes.lap[-1]) + 1)]),
        "beam_azimuth": math.radians(drive.beam_azimuth_deg),
        "ear_baseline": ears.baseline_m,
        "sensor": echoes.sensor,
        "layout": ears.settings.array.layout,
        "pose_source": drive.poses.source,
        "odometry_source": drive.odometry.source,
    }
    variables = {
        "gt_pose": true,
        "gt_delta": gt_delta,
        "odom_delta": odom_delta,
        "t": (echoes.time_ns - echoes.time_ns[0]) / _NS_PER_S,
        "lap": echoes.lap,
        "echo_left": echoes.left,
        "echo_right": echoes.right,
        "echo_scale": echoes.scale,
        "meta": meta,
        "reflectors": _reflectors(drive.scene, true, ears.max_range_m),
    }
    with path.open("wb") as file:
        scipy.io.savemat(file, variables, do_compression=True, oned_as="column")


class _EchoRows(NamedTuple):
    """Echoes of all measurements, as integers and their scale, and their times."""

    ears: VirtualEars
    sensor: str
    left: NDArray[np.int16]
    right: NDArray[np.int16]
    scale: Floats
    time_ns: NDArray[np.int64]
    lap: Floats

    @classmethod
    def of(cls, measurements: Iterable[Measurement], beam_azimuth_deg: float) -> "_EchoRows":
        ears: VirtualEars | None = None
        sensor = ""
        rows: list[tuple[NDArray[np.int16], NDArray[np.int16]]] = []
        scales, stamps = [], []
        for measurement in measurements:
            if not isinstance(measurement, Measurement):
                raise ArgumentError(
                    f"{type(measurement).__name__} is given, but format 'batslam' holds the signals of measurements; "
                    "choose a recording"
                )
            if ears is None:
                ears, sensor = VirtualEars(measurement.settings, beam_azimuth_deg), measurement.stamp.sensor
            _require_equal(ears, sensor, measurement)
            pair = ears(measurement)
            scale = max(float(np.max(np.abs(pair))), np.finfo(float).eps) / _FULL_SCALE
            rows.append((_rounded(pair.left, scale), _rounded(pair.right, scale)))
            scales.append(scale)
            stamps.append(measurement.stamp)
        if ears is None or len(rows) < 2:
            raise ArgumentError(
                f"format 'batslam' needs at least 2 measurements, but {'no' if ears is None else 'one'} is given; "
                "record a drive"
            )
        _require_size(len(rows), ears.n_samples)
        time_ns = np.array([stamp.timestamp_ns for stamp in stamps])
        _require_order(time_ns)
        sessions = np.array([stamp.session_id for stamp in stamps])
        left, right = (np.stack([row[side] for row in rows]) for side in (0, 1))
        lap = np.cumsum(np.concatenate([[1], np.diff(sessions) != 0]), dtype=np.float64)
        return cls(ears, sensor, left, right, np.array(scales), time_ns, lap)


def _rounded(signal: Floats, scale: float) -> NDArray[np.int16]:
    return np.rint(signal / scale).astype(np.int16)


def _require_equal(ears: VirtualEars, sensor: str, measurement: Measurement) -> None:
    """Raise an error for another sensor or other settings; the speed of sound may change."""
    if measurement.stamp.sensor != sensor:
        raise ArgumentError(
            f"sensors {sensor} and {measurement.stamp.sensor} are given, but format 'batslam' holds one; choose one "
            "(sensor)"
        )
    first, other = ears.settings, measurement.settings
    for name in ("array", "recording", "call"):
        if getattr(first, name) != getattr(other, name):
            raise ArgumentError(
                f"measurement {measurement.stamp.sequence} has another {name} than the first; choose measurements with "
                "equal settings (measurement)"
            )


def _require_size(count: int, n_samples: int) -> None:
    if count * n_samples * np.dtype(np.int16).itemsize > _MAX_BYTES:
        raise ArgumentError(
            f"{count} measurements of {n_samples} samples exceed the 2 GiB of a variable in MATLAB v7; choose fewer "
            "(measurement), or shorten processing.range_m"
        )


def _require_order(time_ns: NDArray[np.int64]) -> None:
    late = np.flatnonzero(np.diff(time_ns) <= 0)
    if late.size:
        raise ArgumentError(
            f"measurement [{late[0] + 1}] is not later than the one before, so times are unknown or out of order; use "
            "a recording whose timestamps increase"
        )


def _at(trajectory: Trajectory, time_ns: NDArray[np.int64], name: str) -> Trajectory:
    """Return the poses at the measurements."""
    try:
        return trajectory.at(time_ns)
    except ArgumentError as error:
        raise ArgumentError(f"{name}: {error}") from error


def _planar(platform: Trajectory, mounting: Mounting | None) -> Floats:
    """Return x and y in metres and heading in radians of the sensor: (pose, 3) float64."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  importing it takes longer than this package

    rotation = Rotation.from_quat(platform.rotation_xyzw)
    position_m = platform.position_m
    if mounting is not None:
        position_m = position_m + rotation.apply(mounting[0])
        rotation = rotation * Rotation.from_quat(mounting[1])
    ahead = rotation.apply([1.0, 0.0, 0.0])
    return np.column_stack([position_m[:, :2], np.arctan2(ahead[:, 1], ahead[:, 0])])


def _deltas(pose: Floats) -> Floats:
    """Return each pose in the frame of the one before: (pose - 1, 3) float64."""
    step = np.diff(pose, axis=0)
    c, s = np.cos(pose[:-1, 2]), np.sin(pose[:-1, 2])
    turn = np.remainder(step[:, 2] + math.pi, 2 * math.pi) - math.pi
    return np.column_stack([c * step[:, 0] + s * step[:, 1], c * step[:, 1] - s * step[:, 0], turn])


def noise_model(true: Floats, measured: Floats) -> dict[str, Any]:
    """Return the noise model of the simulator, fitted to the odometry."""
    # The step is too long by a factor, the heading drifts, and random errors grow with the root of the distance.
    distance_m = np.hypot(true[:, 0], true[:, 1])
    error = measured - true
    forward = float(np.sum(true[:, 0] ** 2))
    total_m = float(np.sum(distance_m))
    scale = float(np.sum(error[:, 0] * true[:, 0])) / forward if forward else 0.0
    drift = float(np.sum(error[:, 2])) / total_m if total_m else 0.0
    rest = error - np.column_stack([scale * true[:, 0], np.zeros(len(true)), drift * distance_m])
    spread = np.sqrt(np.sum(rest**2, axis=0) / total_m) if total_m else np.zeros(3)
    return {"odom_sigma": spread[None, :], "odom_bias_rot": drift, "odom_bias_scale": scale}


_Row: TypeAlias = tuple[str, Floats, float, Floats, Floats, float]
"""Kind, position, radius, both ends and level of a reflector."""


def _reflectors(scene: Scene | None, pose: Floats, max_range_m: float) -> dict[str, Any]:
    """Return the resting reflectors of a scene, as far as a plan can show them."""
    rows = [] if scene is None else [*_small(scene), *_walls(scene, pose, max_range_m)]
    kinds, position_m, radius_m, start_m, stop_m, level_db = zip(*rows, strict=True) if rows else ((),) * 6
    return {
        "position": _vectors(position_m),
        "type": np.array(kinds, dtype="U6"),
        "radius": np.array(radius_m, dtype=np.float64),
        "endpoint1": _vectors(start_m),
        "endpoint2": _vectors(stop_m),
        "reflectivity": 10 ** (np.array(level_db, dtype=np.float64) / 20),
        "has_signature": np.zeros(len(rows)),
    }


def _small(scene: Scene) -> Iterator[_Row]:
    """Yield points and spheres."""
    none = np.full(3, np.nan)
    for point in scene.points:
        if not point.moves:
            yield "point", point.position_at(0.0), 0.0, none, none, point.strength_db
    for sphere in scene.spheres:
        if not sphere.moves:
            yield "circle", sphere.position_at(0.0), sphere.radius_m, none, none, sphere.reflection_db


def _walls(scene: Scene, pose: Floats, max_range_m: float) -> Iterator[_Row]:
    """Yield walls and sides of boxes, without floors and ceilings."""
    for _, wall in scene.all_walls():
        if not wall.moves and abs(wall.axes()[0][2]) < _UPRIGHT:
            start, stop = _ends(wall, pose, max_range_m)
            yield "wall", (start + stop) / 2, 0.0, start, stop, wall.reflection_db


def _vectors(values: Sequence[Floats]) -> Floats:
    return np.array(values, dtype=np.float64).reshape(-1, 3)


def _ends(wall: Wall, pose: Floats, max_range_m: float) -> tuple[Floats, Floats]:
    """Return both ends of a wall in a plan; an unbounded wall ends at the largest range from the path."""
    centre_m, along = wall.position_at(0.0), wall.axes()[1]
    if wall.size_m is not None:
        half_m = wall.size_m[0] / 2
        return centre_m - half_m * along, centre_m + half_m * along
    reach_m = (pose[:, :2] - centre_m[:2]) @ along[:2]
    return (
        centre_m + (float(np.min(reach_m)) - max_range_m) * along,
        centre_m + (float(np.max(reach_m)) + max_range_m) * along,
    )
