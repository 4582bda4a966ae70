"""Comparison of fused points and of occupancy maps with the scene's ground truth."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.frames import OccupancyMap, PointCloud, Reflector, Surfaces
from ertis_numba.geometry import unit_vectors

__all__ = ["PlaceErrors", "Places", "compare_map", "compare_points", "errors_of_places", "joined", "positions_m"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_GATE_M: Final = 0.1  # Largest distance between a reflector and its point.
_OUTSIDE_M: Final = 0.05  # Distance from all surfaces of a spurious cell, not counting half of its side.
_MIN_DB: Final = -1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaceErrors:
    """Errors of points or occupied cells relative to a scene, over SYNC pulses."""

    # `error_cm` is the RMS distance between reflectors and their points, or between cells and the nearest surface.

    pulses: int
    matched: int
    missed: int
    found: int
    spurious: int
    spurious_confirmed: int
    error_cm: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Comparison of the places of one pulse, or of a map; ``distance_m`` are those of places that are not spurious."""

    matched: Flags
    missed: Flags
    spurious: Flags
    confirmed: Flags
    distance_m: Floats


def compare_points(
    points: PointCloud,
    reflectors: Sequence[Reflector],
    surfaces: Surfaces,
    *,
    is_planar: bool,
    min_level_db: float = -30.0,
) -> Places:
    """Compare the points of a fused pulse with the ground truth in the same frame."""
    # They are assigned one to one within 10 cm, with the least sum of squares. Points farther from everything are
    # spurious.
    counts = _counted(reflectors, min_level_db)
    place_m, true_m = points.position_m.astype(np.float64), positions_m(reflectors)
    if is_planar:
        height_m = np.array([0.0, 0.0, float(np.median(place_m[:, 2])) if len(place_m) else 0.0])
        place_m = place_m - height_m
        true_m, target_m = _unrolled(true_m - height_m), _unrolled(surfaces.centre_m - height_m)
        flat = surfaces.flattened()
        surfaces = Surfaces(target_m, flat.radius_m, flat.disc_m, flat.face_m, flat.axes, flat.half_size_m)
    apart_m = np.linalg.norm(true_m[:, None] - place_m, axis=2)
    matched, distance_m = _assigned(np.where(counts[:, None], apart_m, np.inf))
    is_near = (apart_m <= _GATE_M).any(axis=0) | (surfaces.distance_m(place_m) <= _GATE_M)
    confirmed = np.zeros(len(place_m), np.bool_) if points.confirmed is None else points.confirmed
    return Places(matched, counts & ~matched, ~is_near, np.asarray(confirmed, np.bool_), distance_m)


def compare_map(
    occupancy: OccupancyMap, reflectors: Sequence[Reflector], surfaces: Surfaces, *, min_level_db: float = -30.0
) -> Places:
    """Compare an occupancy map with the ground truth in the same frame; `joined` merges reflectors of several pulses.

    A reflector is found, and a cell is not spurious, within 5 cm and half a cell. Planes ignore heights.
    """
    gate_m = _OUTSIDE_M + occupancy.cell_m / 2
    counts = _counted(reflectors, min_level_db)
    place_m, true_m = occupancy.occupied_m, positions_m(reflectors)
    if occupancy.n_dimensions == 2:
        place_m = np.column_stack([place_m, np.zeros(len(place_m))])
        true_m, surfaces = true_m * [1.0, 1.0, 0.0], surfaces.flattened()
    cell_m, reflector_m = _nearest_m(true_m, place_m), _nearest_m(place_m, true_m)
    away_m = np.minimum(reflector_m, surfaces.distance_m(place_m))
    is_found, is_spurious = cell_m <= gate_m, away_m > gate_m
    confirmed = np.zeros(len(place_m), np.bool_)
    return Places(counts & is_found, counts & ~is_found, is_spurious, confirmed, away_m[~is_spurious])


def errors_of_places(comparisons: Iterable[Places], *, pulses: int | None = None) -> PlaceErrors:
    """Return the errors over several pulses, or those of a map of so many pulses."""
    given = list(comparisons)
    squares = np.concatenate([np.zeros(0), *(each.distance_m**2 for each in given)])
    return PlaceErrors(
        pulses=len(given) if pulses is None else pulses,
        matched=sum(int(each.matched.sum()) for each in given),
        missed=sum(int(each.missed.sum()) for each in given),
        found=sum(len(each.spurious) for each in given),
        spurious=sum(int(each.spurious.sum()) for each in given),
        spurious_confirmed=sum(int((each.spurious & each.confirmed).sum()) for each in given),
        error_cm=100 * math.sqrt(float(squares.mean())) if len(squares) else None,
    )


def positions_m(reflectors: Sequence[Reflector]) -> Floats:
    """Return the positions of reflectors: (reflector, axis) float64."""
    rows = [(each.azimuth_rad, each.elevation_rad, each.range_m) for each in reflectors]
    azimuth_rad, elevation_rad, range_m = np.array(rows, np.float64).reshape(-1, 3).T
    return np.asarray(unit_vectors(azimuth_rad, elevation_rad) * range_m[:, None])


def joined(reflectors: Iterable[Reflector], within_m: float = _GATE_M) -> list[Reflector]:
    """Return reflectors without those of the same name that lie within a distance of a stronger one."""
    kept: dict[str, list[Reflector]] = {}
    for each in sorted(reflectors, key=lambda reflector: -reflector.level_db):
        same = kept.setdefault(each.name, [])
        if not same or np.linalg.norm(positions_m(same) - positions_m([each]), axis=1).min() > within_m:
            same.append(each)
    return [each for same in kept.values() for each in same]


def _counted(reflectors: Sequence[Reflector], min_level_db: float) -> Flags:
    """Return True for reflectors of a sufficient level relative to the strongest: (reflector,) bool."""
    checks.between("min_level_db", min_level_db, _MIN_DB, 0.0)
    level_db = np.array([each.level_db for each in reflectors])
    return np.asarray(level_db >= level_db.max(initial=-np.inf) + min_level_db)


def _unrolled(offset_m: Floats) -> Floats:
    """Return offsets turned into the horizontal plane, at the same distance: (place, axis) float64."""
    turn_rad = np.arctan2(offset_m[:, 1], offset_m[:, 0])
    return np.asarray(unit_vectors(turn_rad, np.zeros(len(offset_m))) * np.linalg.norm(offset_m, axis=1)[:, None])


def _nearest_m(from_m: Floats, to_m: Floats) -> Floats:
    """Return the distance of each place from the nearest other one, infinite without any: (place,) float64."""
    if not len(to_m):
        return np.full(len(from_m), np.inf)
    distance_m, _ = scipy.spatial.cKDTree(to_m).query(from_m)
    return np.asarray(distance_m, np.float64)


def _assigned(apart_m: Floats) -> tuple[Flags, Floats]:
    """Return True for rows with a column within the gate, one to one, and the distances of the pairs."""
    matched = np.zeros(len(apart_m), np.bool_)
    is_near = apart_m <= _GATE_M
    if not is_near.any():
        return matched, np.zeros(0)
    dear = 2.0 * min(apart_m.shape) + 1  # This cost exceeds the sum over all near pairs.
    rows, columns = scipy.optimize.linear_sum_assignment(np.where(is_near, (apart_m / _GATE_M) ** 2, dear))
    paired = is_near[rows, columns]
    matched[rows[paired]] = True
    return matched, np.asarray(apart_m[rows[paired], columns[paired]])
