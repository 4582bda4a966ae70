"""Share of surfaces that occupancy maps show, and of occupied cells that show nothing, in rooms and in a hall.

Images are simulated through PDM, and poses are exact. Nothing is timed except the maps themselves.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

import ertis_numba as ertis
from ertis_bench import machine
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.platform_trials import map_shifts
from ertis_bench.platform_trials.furnished_rooms import (
    HALL_M,
    HEIGHT_M,
    Motion,
    PlatformImager,
    half_size_of_room_m,
    half_size_of_space_m,
    hall,
    mountings,
    random_room,
    random_space,
)
from ertis_numba.frames import OccupancyMap, Trajectory
from ertis_numba.simulation import Box, Point

__all__ = ["FORMS", "MappedPlace", "form", "rated", "run"]

Floats = NDArray[np.float64]

_SPACING_M: Final = 0.05  # of the scatterers of walls
_SPACING_IN_SPACE_M: Final = 0.15  # Spacing of the scatterers of walls, floor and ceiling.
_RANGE_M: Final = {2: 4.0, 3: 3.0}  # End of the images, by number of dimensions.
_DIRECTIONS: Final = {2: "90", 3: "3d:1000"}
# Distance of the platform up to which a sensor's image shows a surface, by number of dimensions.
_IN_VIEW_M: Final = {2: 3.7, 3: 2.7}
_HIGHEST_RAD: Final = math.radians(45.0)  # Elevation up to which the sensors, which face the walls, see a surface.
_STEP_S: Final = 0.05  # between the poses that state the velocity.
_ELLIPSE_M: Final = {2: (1.0, 0.7), 3: (0.5, 0.35)}  # Half axes of the path through a room.
_ON_WALL_M: Final = 0.1  # Distance from a wall within which a scatterer belongs to it.
_FOUND_M: Final = 0.05
_FALSE_M: Final = 0.075
_ROUNDING_M: Final = 1e-6
_PLANES: Final = (
    f"Furnished rooms and a hall of {HALL_M[0]:g} × {HALL_M[1]:g} m, with rough walls of scatterers "
    f"{100 * _SPACING_M:g} cm apart on average, whose strengths are Rayleigh distributed. A platform with four sensors "
    "stands at poses on an ellipse in a room, or drives at 1 m/s through the hall. A wall cell contains a scatterer, "
    f"is at most {_IN_VIEW_M[2]:g} m from a pose, and is not hidden by a box."
)
_SPACES: Final = (
    "Furnished rooms with rough walls, floors and ceilings of scatterers "
    f"{100 * _SPACING_IN_SPACE_M:g} cm apart on average along both axes, whose strengths are Rayleigh distributed. A "
    "platform with four sensors, which face the walls, stands at poses on an ellipse. Images have 1000 directions. A "
    f"surface cell contains a scatterer, is at most {_IN_VIEW_M[3]:g} m from a pose and at most "
    f"{math.degrees(_HIGHEST_RAD):.0f}° above or below the sensors, and is not hidden by a box."
)


class MappedPlace(NamedTuple):
    """Room or hall with its true outlines, in the plane or in space.

    Attributes
    ----------
    points : tuple of Point
    boxes : tuple of Box
    half_m : (x, y) or (x, y, z)
        Distances of the walls, and of floor and ceiling, from the origin at the height of the sensors.
    """

    points: tuple[Point, ...]
    boxes: tuple[Box, ...]
    half_m: tuple[float, ...]

    @property
    def wall_points_m(self) -> Floats:
        """Scatterers of walls, floor and ceiling: (point, axis) float64."""
        places_m = self._points_m
        return places_m[self._from_walls_m(places_m) < _ON_WALL_M]

    @property
    def _points_m(self) -> Floats:
        return np.array([point.position_m for point in self.points], np.float64)[:, : len(self.half_m)]

    def away_m(self, places_m: Floats) -> Floats:
        """Return the distance of places from the nearest wall, post or outline of a box: (place,) float64."""
        away_m = np.minimum(self._from_walls_m(places_m), KDTree(self._points_m).query(places_m)[0])
        for box in self.boxes:
            away_m = np.minimum(away_m, _from_outline_m(_in_box(box, places_m), np.array(box.size_m) / 2))
        return np.asarray(away_m)

    def sees(self, viewer_m: Floats, places_m: Floats) -> NDArray[np.bool_]:
        """Return True for places near the viewer that no box hides: (place,) bool."""
        offset_m = places_m - viewer_m
        range_m = np.linalg.norm(offset_m, axis=1)
        seen = range_m < _IN_VIEW_M[len(self.half_m)]
        if len(self.half_m) == 3:
            seen &= np.abs(offset_m[:, 2]) < math.sin(_HIGHEST_RAD) * range_m
        for box in self.boxes:
            half_m = np.array(box.size_m[: len(self.half_m)]) / 2
            start, end = _in_box(box, viewer_m[None]), _in_box(box, places_m)
            way = np.where(np.abs(end - start) < 1e-9, 1e-9, end - start)
            entries, exits = (-half_m - start) / way, (half_m - start) / way
            first, last = np.minimum(entries, exits).max(axis=1), np.maximum(entries, exits).min(axis=1)
            seen &= ~((first < last) & (last > 0) & (first < 1))
        return np.asarray(seen)

    def _from_walls_m(self, places_m: Floats) -> Floats:
        return _from_outline_m(places_m - _middle_m(len(self.half_m)), np.array(self.half_m))


def _middle_m(n_dimensions: int) -> Floats:
    """Return the middle of a place: (axis,) float64."""
    return np.array([0.0, 0.0, HEIGHT_M][:n_dimensions])


def _from_outline_m(places_m: Floats, half_m: Floats) -> Floats:
    """Return the distances from the outline of a rectangle or a cuboid around the origin: (place,) float64."""
    beyond_m = np.abs(places_m) - half_m[: places_m.shape[1]]
    outside_m = np.linalg.norm(np.maximum(beyond_m, 0.0), axis=1)
    return np.asarray(np.abs(outside_m + np.minimum(beyond_m.max(axis=1), 0.0)))


def _in_box(box: Box, places_m: Floats) -> Floats:
    """Return places in the frame of a box: (place, axis) float64."""
    if box.position_m is None:
        raise ValueError("a box of a place needs position_m")
    yaw_rad = math.radians(box.yaw_deg)
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    local_m = places_m - np.array(box.position_m)[: places_m.shape[1]]
    local_m[:, :2] = local_m[:, :2] @ np.array([[c, -s], [s, c]])
    return np.asarray(local_m)


def rated(found: OccupancyMap, place: MappedPlace, path_m: Floats) -> dict[str, float]:
    """Return the shares of walls that are found, and of occupied cells that are false.

    Parameters
    ----------
    found : OccupancyMap
    place : MappedPlace
    path_m : (pose, axis) float64
        Positions from which the sensors see.

    Returns
    -------
    dict
        ``walls`` is the number of cells that contain scatterers of walls and were in view. ``found`` is the share of
        them with the centre of an occupied cell within 5 cm of their own, and ``near`` that within 7.5 cm. ``false`` is
        the share of occupied cells whose centre is more than 7.5 cm away from all walls, posts and boxes, so that no
        part of them is within 5 cm; ``off`` is the share beyond 5 cm.
    """
    cells = np.unique(np.floor(place.wall_points_m / found.cell_m).astype(np.int64), axis=0)
    walls_m = np.asarray((cells + 0.5) * found.cell_m, np.float64)
    walls_m = walls_m[np.any([place.sees(viewer_m, walls_m) for viewer_m in path_m], axis=0)]
    nearest_m = KDTree(found.occupied_m).query(walls_m)[0]
    away_m = place.away_m(found.occupied_m)
    return {
        "walls": len(walls_m),
        "found": float(np.mean(nearest_m < _FOUND_M + _ROUNDING_M)),
        "near": float(np.mean(nearest_m < _FALSE_M + _ROUNDING_M)),
        "occupied": len(away_m),
        "false": float(np.mean(away_m > _FALSE_M + _ROUNDING_M)),
        "off": float(np.mean(away_m > _FOUND_M + _ROUNDING_M)),
    }


def run(
    *,
    count: int,
    poses: int,
    length_m: float,
    rate_hz: float,
    seed: int,
    say: Callable[[str], None],
    only: Sequence[str] = (),
) -> dict[str, Any]:
    """Map random rooms and a hall."""
    if "shifts" in only:
        return map_shifts.run(seed=seed, say=say)
    dimensions = 3 if only else 2
    rows = []
    for number in range(seed, seed + count):
        if dimensions == 3:
            place = MappedPlace(*random_space(number, _SPACING_IN_SPACE_M), half_size_of_space_m(number))
        else:
            place = MappedPlace(*random_room(number, _SPACING_M), half_size_of_room_m(number))
        rows.append(_mapped(f"room {number}", place, _round(poses, dimensions), number, rate_hz, say))
    if length_m and dimensions == 2:
        scene = hall(seed, _SPACING_M)
        assert scene.platform is not None  # noqa: S101  halls have one
        place = MappedPlace(scene.points, (), (HALL_M[0] / 2, HALL_M[1] / 2))
        motions = [Motion.of(scene.platform, time_s) for time_s in np.arange(0.0, length_m, 1 / rate_hz)]  # at 1 m/s
        rows.append(_mapped(f"hall {seed}", place, motions, seed, rate_hz, say))
    return {
        "machine": machine.describe(),
        "seed": seed,
        "length_m": length_m,
        "rate_hz": rate_hz,
        "dimensions": dimensions,
        "rows": rows,
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    if "shifts" in report:
        return map_shifts.form(report)
    is_planar = report["dimensions"] == 2
    kind = "wall" if is_planar else "surface"
    head = [
        "place",
        "pulses",
        f"{kind} cells in view",
        "found (within 7.5 cm)",
        "occupied cells",
        "false (beyond 5 cm)",
        "time",
    ]
    rows = [
        [
            row["name"],
            str(row["pulses"]),
            str(row["walls"]),
            f"{row['found']:.1%} ({row['near']:.1%})",
            str(row["occupied"]),
            f"{row['false']:.1%} ({row['off']:.1%})",
            f"{1e3 * row['median_s']:.0f} ms ({1e3 * row['fused_s']:.0f} ms)",
        ]
        for row in report["rows"]
    ]
    places = _PLANES if is_planar else _SPACES
    return (
        f"{table(head, rows)}\n\n{places} Poses and velocities are exact, and cells are 5 cm wide. A {kind} cell is "
        "found if the centre of an occupied cell is within 5 cm of its own. An occupied cell is false if its centre is "
        f"more than 7.5 cm away from all {kind}s, posts and boxes, so that no part of it is within 5 cm; the share "
        "beyond 5 cm is in brackets. Times are medians of the processor time per pulse, without fusion and (in "
        "brackets) with it. "
        f"{sentence(report['machine'])}"
    )


def _round(count: int, dimensions: int = 2) -> list[Motion]:
    """Return poses on an ellipse, at rest and in the direction of the path."""
    turns_rad = np.arange(count) * (2 * math.pi / count)
    along_m, across_m = _ELLIPSE_M[dimensions]
    return [
        Motion(along_m * math.cos(turn), across_m * math.sin(turn), turn + math.pi / 2, 0.0, 0.0, 0.0)
        for turn in turns_rad.tolist()
    ]


def _mapped(
    name: str,
    place: MappedPlace,
    motions: Sequence[Motion],
    seed: int,
    rate_hz: float,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Return the shares and times of the map of a place."""
    n_dimensions = len(place.half_m)
    imager = PlatformImager(
        (place.points, place.boxes), seed, max_range_m=_RANGE_M[n_dimensions], directions=_DIRECTIONS[n_dimensions]
    )
    mapper, fuser = ertis.Mapper(mountings(), dimensions=n_dimensions), ertis.Fuser(mountings())
    taken_s, fused_s = [], []
    for number, motion in enumerate(motions):
        images = imager(motion, number, number / rate_hz)
        begin_s = time.process_time()
        fused = fuser(images)
        _ = fused.points
        after_s = time.process_time()
        mapper.add(images, _around(motion, fused.stamp.timestamp_ns), fused=fused)
        end_s = time.process_time()
        taken_s.append(end_s - after_s)
        fused_s.append(end_s - begin_s)
        if number % 20 == 0:
            say(f"{name}: pulse {number} of {len(motions)}")
    imager.close()
    path_m = np.array([[motion.x_m, motion.y_m, HEIGHT_M] for motion in motions])
    shares = rated(mapper.map, place, path_m[:, :n_dimensions])
    say(f"{name}: {shares}")
    times = {"median_s": float(np.median(taken_s)), "fused_s": float(np.median(fused_s))}
    return {"name": name, "pulses": len(motions), **shares, **times}


def _around(motion: Motion, time_ns: int) -> Trajectory:
    """Return poses shortly before and after a motion, which also have its velocity."""
    poses = [motion.after(time_s) for time_s in (-_STEP_S, 0.0, _STEP_S)]
    yaw_rad = np.array([pose.yaw_rad for pose in poses]) / 2
    zeros = np.zeros(len(poses))
    return Trajectory(
        time_ns + np.rint(np.array([-_STEP_S, 0.0, _STEP_S]) * 1e9).astype(np.int64),
        np.stack([[pose.x_m for pose in poses], [pose.y_m for pose in poses], zeros], axis=1),
        np.stack([zeros, zeros, np.sin(yaw_rad), np.cos(yaw_rad)], axis=1),
    )


FORMS = {"map": form}
"""Forms of the table, by the name in its markers."""
