"""Places between the directions of a grid, and those that are farthest from all of them."""

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import grid_count, named_grid, spacing_rad, unit_vectors
from ertis_numba.settings import Processing

__all__ = ["Between", "farthest_places"]

Floats = NDArray[np.float64]

_GAP: Final = 4.0  # A gap wider than this, relative to the median, separates two sets of directions.
_SIDE: Final = 90  # Places along each side of the limits.
_PIECES: Final = 4000  # Triangles that are searched.
_PARTS: Final = 6  # Steps along a side of a triangle.
_ARC_STEPS: Final = 11
_TOP: Final = 64
_STEPS: Final = 7
_TRIES: Final = 24
_FLAT: Final = 1e-9
_BEHIND: Final = 0.1  # Triangles nearer to the centre of the sphere close its open side.


class Between:
    """Places (place, axis) between directions, or for a spatial grid with a name, within its limits."""

    def __init__(self, directions: Floats, processing: Processing) -> None:
        limits = _limits_rad(processing, len(directions))
        self._limits_rad, self._directions = limits, directions
        self.is_planar = limits is None and _is_circle(directions)
        if limits is not None:
            self.places = _within(*limits)
        elif self.is_planar:
            self.places = _middles(directions)
        else:
            self.places = _in_triangles(directions)

    def everywhere(self) -> Floats:
        """Return places all over the directions and between them: (place, axis) float64."""
        if self._limits_rad is not None:
            return self.places
        if not self.is_planar:
            return np.concatenate([self.places, self._directions])
        turned = [_middles(self._directions, share) for share in np.linspace(0, 1, _ARC_STEPS)]
        return np.concatenate([*turned, self._directions])

    def step_rad(self) -> float:
        """Return the largest step of a search that starts in the places, in radians."""
        if self._limits_rad is None:
            return spacing_rad(self._directions) / (2 * _PARTS)  # Places are dense, and have no limits.
        (west, east), (low, high) = self._limits_rad
        count = len(self._directions)
        return max(math.sqrt((east - west) * (math.sin(high) - math.sin(low)) / count), (east - west) / count) / 2

    def clip(self, places: Floats) -> Floats:
        """Return unit vectors in the same directions, moved into the limits."""
        if self._limits_rad is None:
            return np.asarray(places / np.linalg.norm(places, axis=-1, keepdims=True))
        (west, east), (low, high) = self._limits_rad
        azimuth = np.arctan2(places[..., 1], places[..., 0])
        middle = (west + east) / 2
        azimuth = middle + np.remainder(azimuth - middle + math.pi, 2 * math.pi) - math.pi
        elevation = np.arctan2(places[..., 2], np.hypot(places[..., 0], places[..., 1]))
        return unit_vectors(np.clip(azimuth, west, east), np.clip(elevation, low, high))


def farthest_places(between: Between, distance: Callable[[Floats], Floats]) -> Floats:
    """Return the places (place, axis) with the largest distance from a grid; ``distance`` returns those of places."""
    places = between.places[np.argsort(-distance(between.places))[:_TOP]]
    if between.is_planar:
        return np.asarray(places)
    random, step = np.random.default_rng(0), between.step_rad()
    for _ in range(_STEPS):
        moved = places[:, None] + step * random.normal(size=(len(places), _TRIES, 3))
        tried = np.concatenate([places[:, None], between.clip(moved)], axis=1)
        found = distance(tried.reshape(-1, 3)).reshape(tried.shape[:2])
        places = tried[np.arange(len(places)), found.argmax(axis=1)]
        step /= 2
    return np.asarray(places)


def _limits_rad(processing: Processing, count: int) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return the limits of the azimuth and the elevation of a spatial grid with a name; None for other grids."""
    named = named_grid(processing)
    if named is None or named[0] == "2d" or grid_count(processing.directions) != count or count < 2:
        return None
    (west, east), (low, high) = np.radians(named[1:]).tolist()
    return (west, east), (low, high)


def _within(azimuth_rad: tuple[float, float], elevation_rad: tuple[float, float]) -> Floats:
    """Return places at equal steps of the azimuth and of the sine of the elevation, with the borders."""
    azimuth = np.linspace(azimuth_rad[0], azimuth_rad[1], _SIDE)
    sine = np.linspace(math.sin(elevation_rad[0]), math.sin(elevation_rad[1]), _SIDE)
    return unit_vectors(np.tile(azimuth, _SIDE), np.repeat(np.arcsin(np.clip(sine, -1, 1)), _SIDE))


def _is_circle(directions: Floats) -> bool:
    """Return True if all directions lie in one plane."""
    if len(directions) < 4:
        return True
    return bool(np.linalg.svd(directions - directions.mean(axis=0), compute_uv=False)[2] < _FLAT * len(directions))


def _middles(directions: Floats, share: float = 0.5) -> Floats:
    """Return places between neighbours on a circle, at a share of their gaps, except across wide gaps."""
    centred = directions - directions.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    if len(directions) == 2:  # On the great circle through both.
        axes = np.linalg.svd(directions)[2].T[:, ::-1]
    normal, first, second = axes.T
    centre = (directions[0] @ normal) * normal
    angle_rad = np.sort(np.arctan2(directions @ second, directions @ first))
    gaps_rad = np.append(angle_rad[1:], angle_rad[0] + 2 * math.pi) - angle_rad
    wide = gaps_rad > _FLAT
    near = wide & (gaps_rad <= _GAP * np.median(gaps_rad[wide])) & (gaps_rad <= math.pi + _FLAT)
    middle_rad = (angle_rad + share * gaps_rad)[near]
    radius = math.sqrt(max(0.0, 1 - float(centre @ centre)))
    return np.asarray(centre + radius * (np.cos(middle_rad)[:, None] * first + np.sin(middle_rad)[:, None] * second))


def _in_triangles(directions: Floats) -> Floats:
    """Return places in the triangles between directions on a sphere."""
    from scipy.spatial import ConvexHull  # noqa: PLC0415  Few grids are lists, and the import takes a tenth of a second.

    triangles = directions[ConvexHull(directions).simplices]
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    triangles = triangles[longest <= _GAP * np.median(longest)]
    if len(triangles) > _PIECES:
        triangles = triangles[np.random.default_rng(0).choice(len(triangles), _PIECES, replace=False)]
    steps = np.arange(_PARTS + 1) / _PARTS
    first, second = np.meshgrid(steps, steps)
    kept = first + second <= 1 + _FLAT
    shares = np.stack([first[kept], second[kept], 1 - first[kept] - second[kept]], axis=1)
    places = (shares @ triangles).reshape(-1, 3)
    size = np.linalg.norm(places, axis=1, keepdims=True)
    return np.asarray(places[size[:, 0] > _BEHIND] / size[size[:, 0] > _BEHIND])
