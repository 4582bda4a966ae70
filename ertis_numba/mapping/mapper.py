"""Occupancy mapping from the images of a platform at known poses."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Energyscape, OccupancyMap, PointCloud, Trajectory
from ertis_numba.frames.pose_doubts import PoseWatch, warn_of_poses
from ertis_numba.fusion import Fused, Fuser
from ertis_numba.fusion.rig import Emitters, Mountings, emitter_diameter_m, mounted_sensors
from ertis_numba.geometry import mounting
from ertis_numba.mapping.cell_grid import CellGrid
from ertis_numba.mapping.coverage import Coverage, heard_m
from ertis_numba.mapping.echoes import LocatedEchoes, UsualAmplitude, View, displaced_covariance, echoes_of
from ertis_numba.mapping.sensor_model import add_evidence
from ertis_numba.motion import compensate_motion
from ertis_numba.motion.pose_check import PoseCheck

if TYPE_CHECKING:
    from ertis_numba.settings import Air, Call

__all__ = ["AttitudeCheck", "Mapper", "Pose"]

Floats = NDArray[np.float64]
Pose = tuple[Sequence[float], Sequence[float]] | Trajectory
"""Position x, y, z in m and unit quaternion x, y, z, w from the platform frame to the world frame, or a trajectory."""

_NS_PER_S: Final = 1e9
_PLANAR: Final = np.ix_([0, 1, 5], [0, 1, 5])
"""Elements of a covariance for x, y and the heading."""


class Mapper:
    """Occupancy map that grows with the images of a platform at known poses.

    Echoes are fused (`Fuser`) and located. Each point adds evidence to the cells of its uncertainty ellipse or
    ellipsoid, and points that the fusion does not confirm must repeat. Cells in front of the first clear echo of a
    direction become free. Silence alone shows free space near the platform only, and none if no echo proves that a
    sensor emits (`Fused.without_own_echo`). Uncertain poses spread the evidence of echoes, and shorten free space.
    An obstacle nearer than the first range of the images may hide others, so that space behind it becomes free.
    docs/how-to/mapping.md has the rules.

    Parameters
    ----------
    mountings : mapping of str to (translation_m, rotation_xyzw)
        Mountings of all sensors, as for `Fuser`.
    dimensions : {2, 3}, default 2
        3 for a map of cubic cells, which needs images with directions over elevation; 2 for one of square cells in the
        horizontal plane.
    cell_m : float, default 0.05
        Side of the cells in metres.
    half_life_s : float, optional
        Time in which log-odds decay to one half, for places where things move; None keeps them.
    height_m : (float, float), optional
        Lowest and highest height of points in the world frame, in metres, to leave out floor and ceiling; all by
        default. A map of three dimensions has cells at these heights only, which saves memory and time.
    emitter_diameter_m : float, optional
        Diameter of the emitters as pistons, as for `Fuser`: 0 for omnidirectional ones, and by default, that in the
        settings of each sensor.

    Raises
    ------
    ArgumentError
        A mounting is missing or invalid, or an option is out of range.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> unturned = (0.0, 0.0, 0.0, 1.0)
    >>> mapper = ertis.Mapper({"sensor": ((0.0, 0.0, 0.0), unturned)})
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     mapper.add([ertis.Pipeline(recording.settings).process(recording[0])], ((1.0, 2.0, 0.0), unturned))
    >>> mapper.map.n_groups, bool(mapper.map.log_odds_at((1.6, 2.0)) < 0)
    (1, True)
    """

    def __init__(
        self,
        mountings: Mountings,
        *,
        dimensions: int = 2,
        cell_m: float = 0.05,
        half_life_s: float | None = None,
        height_m: tuple[float, float] | None = None,
        emitter_diameter_m: float | None = None,
    ) -> None:
        self._fuser = Fuser(mountings, emitter_diameter_m=emitter_diameter_m)
        self._mountings = {sensor.name: sensor for sensor in mounted_sensors(mountings)}
        self._dimensions = checks.integer("dimensions", dimensions, 2, 3)
        self._given_m = emitter_diameter_m
        self._cell_m = checks.between("cell_m", cell_m, 0.005, 1.0)
        self._half_life_s = None if half_life_s is None else checks.positive("half_life_s", half_life_s)
        self._height_m = (-math.inf, math.inf)
        if height_m is not None:
            checks.interval("height_m", height_m, -1e4, 1e4)
            self._height_m = height_m
        places_m = np.array([sensor.translation_m for sensor in self._mountings.values()])
        self._near_m = float(np.hypot(*places_m.T[:2]).max())
        self._centre_m = np.array([0.0, 0.0, places_m[:, 2].mean()])  # Origin of directions in space, at the sensors.
        self._grid = CellGrid(self._cell_m, self._dimensions, self._height_m)
        self._usual, self._heard = UsualAmplitude(), UsualAmplitude()  # within the limits of height, and anywhere
        self._coverages: dict[tuple[tuple[str, float, float, float, float], ...], Coverage] = {}
        self._emitters: dict[tuple[Call, Air], Emitters] = {}
        self._n_groups, self._time_ns, self._n_points, self._n_empty = 0, 0, 0, 0
        self._without_own_echo: Counter[str] = Counter()
        self._attitude, self._motion = AttitudeCheck(), PoseCheck(mountings)

    @property
    def map(self) -> OccupancyMap:
        """Map of all groups so far, as a copy."""
        log_odds, origin_m = self._grid.used()
        return OccupancyMap(log_odds, origin_m, self._cell_m, self._n_groups, self._time_ns)

    @property
    def n_points(self) -> int:
        """Number of points of all groups so far that lie within the heights."""
        return self._n_points

    @property
    def n_empty(self) -> int:
        """Number of groups so far whose images hold no echo above their noise."""
        return self._n_empty

    @property
    def without_own_echo(self) -> dict[str, int]:
        """Number of groups so far in which no echo proves that a sensor emits, by sensor (`Fused.without_own_echo`)."""
        return dict(self._without_own_echo)

    def emitter_warning(self) -> str | None:
        """Return a warning if echoes contradict the stated diameter of the emitters, as `Fuser.emitter_warning`.

        It is None if fused pulses were added; ask their `Fuser`.
        """
        return self._fuser.emitter_warning()

    def pose_warning(self) -> str | None:
        """Return a warning if the echoes of some pulses contradict the motion of the trajectory, with likely causes."""
        return self._motion.warning()

    def pose_note(self) -> str | None:
        """Return the reason why the motion of the trajectory could not be compared with the echoes, if so."""
        return self._motion.note()

    def add(self, images: Iterable[Energyscape], pose: Pose, *, fused: Fused | None = None) -> None:
        """Add the images of one SYNC pulse.

        Parameters
        ----------
        images : iterable of Energyscape
            At most one image of each sensor. Sensors may be missing.
        pose : (translation_m, rotation_xyzw) or Trajectory
            Pose of the platform in the world frame: position x, y, z in metres, and the unit quaternion x, y, z, w that
            rotates the platform frame into the world frame. A trajectory is interpolated at the time of the pulse. Its
            velocity, if known, compensates the motion during the measurement (`compensate_motion`). Its covariances, if
            any, add to those of the points.
        fused : Fused, optional
            Result of a `Fuser` with the same mountings for these images, if it is available; computed by default.

        Raises
        ------
        ArgumentError
            The pose is invalid, the trajectory does not cover the time of the pulse, the images do not fit together or
            have too few dimensions, or the map would have too many cells.
        DataError
            The images are not from the same pulse, no sensor emitted, the trajectory is too fast, or with a half-life,
            the time of the images is before that of earlier ones.

        Warns
        -----
        PoseWarning
            Most poses tilt the platform by more than 30°, or the path is steeper than 30°. Issued once.
        """
        group = tuple(checks.items("images", images, Energyscape, "Pipeline.process returns"))
        if self._dimensions == 3 and any(image.is_planar for image in group):
            raise ArgumentError(
                "images include a planar image, but a map of three dimensions needs directions over elevation; process "
                "with directions such as 3d:1000, or use dimensions 2"
            )
        fused = self._fuser(group) if fused is None else fused
        time_ns = fused.stamp.timestamp_ns
        translation_m, rotation, covariance = _pose(pose, time_ns)
        self._attitude(pose, translation_m, rotation)
        if isinstance(pose, Trajectory):
            self._motion.add(group, pose)
        view = self._view(translation_m, rotation, covariance)
        points = _at_rest(fused.points, pose, rotation) if isinstance(pose, Trajectory) else fused.points
        echoes = self._echoes(points, translation_m, rotation, view)
        coverage = self._coverage(group, fused)
        self._decay(time_ns)
        self._grid.view_from(view.place_m, view.rotation, self._near_m)
        window = self._grid.window(view.place_m, coverage.reach_m)
        add_evidence(window, view, echoes, coverage, near_m=self._near_m)
        self._n_groups += 1
        self._n_empty += fused.is_empty
        self._without_own_echo.update(fused.without_own_echo)
        self._time_ns = max(time_ns, self._time_ns)

    def _view(self, translation_m: Floats, rotation: Floats, covariance: Floats) -> View:
        """Return the view from the sensors in space, or from the platform with its heading in a plane."""
        centre_m = rotation @ self._centre_m
        if self._dimensions == 3:
            return View(translation_m + centre_m, rotation, displaced_covariance(covariance, centre_m[None])[0])
        height_m = np.array([0.0, 0.0, centre_m[2]])
        covariance = displaced_covariance(covariance, height_m[None])[0]
        heading_rad = math.atan2(rotation[1, 0], rotation[0, 0])
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        planar = np.zeros((6, 6))
        planar[_PLANAR] = covariance[_PLANAR]
        return View(translation_m, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), planar)

    def _decay(self, time_ns: int) -> None:
        """Let the log-odds decay since the last group."""
        if self._half_life_s is None or not self._n_groups:
            return
        after_s = (time_ns - self._time_ns) / _NS_PER_S
        if after_s < 0:
            raise DataError(
                f"the images are from {-after_s:.3g} s before those added last; add groups in the order of their "
                "times, or leave out half_life_s"
            )
        self._grid.decay(0.5 ** (after_s / self._half_life_s))

    def _coverage(self, group: Sequence[Energyscape], fused: Fused) -> Coverage:
        """Return the coverage of the sensors of a group that emitted."""
        emitted = [image for image in group if image.stamp.behaviour != "passive"]
        if not emitted:
            raise DataError("no sensor emitted, so the images show no free space; leave out passive measurements")
        limits_m = [(float(image.range_m[0]), float(image.range_m[-1])) for image in emitted]
        names = [image.stamp.sensor for image in emitted]
        diameters_m = [emitter_diameter_m(image.settings, self._given_m) for image in emitted]
        ends_m = [self._heard_m(image, fused) for image in emitted]
        each = zip(names, limits_m, diameters_m, ends_m, strict=True)
        key = tuple((name, *limits, diameter_m, end_m) for name, limits, diameter_m, end_m in each)
        if key not in self._coverages:
            self._coverages[key] = Coverage.of(
                [self._mountings[name] for name in names],
                limits_m,
                emitted[0].settings,
                diameters_m,
                self._cell_m / 2,
                heard_m=ends_m,
                height_m=float(self._centre_m[2]) if self._dimensions == 3 else None,
            )
        return self._coverages[key]

    def _heard_m(self, image: Energyscape, fused: Fused) -> float:
        """Return the distance up to which a clear echo of a sensor's call exceeds the noise of its image."""
        sensor, settings = image.stamp.sensor, image.settings
        if sensor in fused.unheard or (sensor in fused.without_own_echo and sensor not in fused.undecided):
            return 0.0
        key = settings.call, settings.air
        if key not in self._emitters:
            self._emitters[key] = Emitters(settings, [0.0])
        return heard_m(self._emitters[key], self._heard.clear, fused.noise[sensor], float(image.range_m[-1]))

    def _echoes(self, points: PointCloud, translation_m: Floats, rotation: Floats, view: View) -> LocatedEchoes:
        """Return the points within the limits of height, in the frame of a view."""
        place_m = points.position_m.astype(np.float64) @ rotation.T + translation_m
        kept = (place_m[:, 2] >= self._height_m[0]) & (place_m[:, 2] <= self._height_m[1])
        self._n_points += int(kept.sum())
        offset_m = (place_m[kept] - view.place_m) @ view.rotation
        if self._dimensions == 2:
            offset_m[:, 2] = 0.0
        uncertainty_m = np.zeros((len(points), 2)) if points.uncertainty_m is None else points.uncertainty_m
        strength = self._usual.strength(points.amplitude[kept])
        self._heard.strength(points.amplitude)
        uncertainty_m = np.asarray(uncertainty_m, np.float64)[kept]
        confirmed = None if points.confirmed is None else points.confirmed[kept]
        return echoes_of(offset_m, uncertainty_m, strength, self._dimensions, confirmed)


def _at_rest(points: PointCloud, trajectory: Trajectory, rotation: Floats) -> PointCloud:
    """Return points, compensated for the velocity of a trajectory if it is known."""
    if len(trajectory) == 1:
        return points
    linear_m_s, angular_rad_s = (each[0] @ rotation for each in trajectory.velocity_at([points.stamp.timestamp_ns]))
    if np.isnan(linear_m_s).any():
        return points
    try:
        return compensate_motion(points, linear_m_s.tolist(), float(angular_rad_s[2]))
    except ArgumentError as error:  # The velocity exceeds a limit.
        raise DataError(
            f"at {points.stamp.timestamp_ns / _NS_PER_S:.3f} s, the poses move at {np.linalg.norm(linear_m_s):.4g} m/s "
            f"and turn at {math.degrees(angular_rad_s[2]):.4g} °/s; correct the poses"
        ) from error


def _pose(pose: Pose, time_ns: int) -> tuple[Floats, Floats, Floats]:
    """Return position, rotation matrix and covariance of a pose at a time: (3,), (3, 3) and (6, 6) float64."""
    if isinstance(pose, Trajectory):
        now = pose.at([time_ns])
        covariance = np.zeros((6, 6)) if now.covariance is None else now.covariance[0]
        return now.position_m[0], Rotation.from_quat(now.rotation_xyzw[0]).as_matrix(), covariance
    try:
        translation_m, rotation_xyzw = pose
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"pose is {pose!r}; pass a position and a unit quaternion, or a Trajectory") from error
    found = mounting("platform", translation_m, rotation_xyzw)
    return found["translation_m"], Rotation.from_quat(found["rotation_xyzw"]).as_matrix(), np.zeros((6, 6))


_CALLER: Final = 3  # stack level of the caller of Mapper.add


class AttitudeCheck:
    """Check of the poses of a mapper: each trajectory as a whole, and single poses together."""

    def __init__(self) -> None:
        self._trajectory: Trajectory | None = None
        self._watch = PoseWatch()

    def __call__(self, pose: Any, translation_m: NDArray[np.float64], rotation: NDArray[np.float64]) -> None:
        """Issue a `PoseWarning` for a doubtful pose of a pulse, once for each trajectory."""
        if not isinstance(pose, Trajectory):
            self._watch(translation_m, Rotation.from_matrix(rotation).as_quat(), stacklevel=_CALLER)
        elif pose is not self._trajectory:
            self._trajectory = pose
            warn_of_poses(pose, stacklevel=_CALLER)
