"""Angles that an array can observe."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry.delays import unit_vectors
from ertis_numba.geometry.layouts import microphones
from ertis_numba.settings import Array

__all__ = ["HEIGHT_NOTE", "ObservableAngles", "direction_note", "observable_angles", "require_places"]

_FLAT: Final = 1e-3  # Width of an array relative to its length, below which it has no width.
_SAME: Final = 1e-9  # Largest distance of equal unit vectors.
_POINT_M: Final = 1e-6  # Microphones closer than this are in one place.
_IN_PLANE: Final = "has its microphones in a plane"
_UPRIGHT: Final = 0.05  # Component of a unit vector, below which it is 0: 3°.
HEIGHT_NOTE: Final = (
    "all directions have elevation 0°, so points are at the height of the sensors; their standard deviations allow for "
    "reflectors up to 12° above or below it"
)
"""Note on points of planar images of several sensors."""


class ObservableAngles(NamedTuple):
    """Angles that an array can observe: False for an angle if echoes from all of its values sound alike."""

    # `note` is a predicate with the angles and the reason; `line` is the unit vector along an array on a line.

    azimuth: bool
    elevation: bool
    note: str | None = None
    line: NDArray[np.float64] | None = None

    def has_direction(self, *, is_planar: bool) -> bool:
        """Return True if images differ between directions, which may all lie at one elevation."""
        is_upright = self.elevation and not self.azimuth
        return self.azimuth or (self.line is not None and not (is_planar and is_upright))

    def observed_rad(self, azimuth_rad: float, elevation_rad: float, *, is_planar: bool) -> tuple[float, float]:
        """Return the azimuth and the elevation of a direction; NaN for angles that the array cannot observe."""
        # For arrays on a horizontal line, the azimuth is that of the direction in the horizontal plane that sounds
        # alike.
        if self.line is not None and self.azimuth and not is_planar:
            (direction,) = unit_vectors(np.array([azimuth_rad]), np.array([elevation_rad]))
            along = float(np.arctan2(self.line[1], self.line[0]))
            angle = float(np.arccos(np.clip(direction @ self.line, -1.0, 1.0)))
            both = np.array([along + angle, along - angle])
            nearest = int(np.argmax(np.cos(both) * direction[0] + np.sin(both) * direction[1]))
            azimuth_rad = float(np.angle(np.exp(1j * both[nearest])))
        return azimuth_rad if self.azimuth else math.nan, elevation_rad if self.elevation else math.nan


def observable_angles(array: Array, grid: DegreesFromRadians | None = None) -> ObservableAngles:
    """Return the angles that the enabled microphones of an array can observe.

    Microphones in one place observe no angle. Those on a line observe the angle to this line only: the azimuth of
    echoes in the horizontal plane, if the line is horizontal, or the elevation, if it is vertical. Those in a plane
    cannot tell its two sides apart, which matters for grids with directions on both.

    Parameters
    ----------
    array : Array
    grid : Grid, or a result with directions, optional
        Directions to compare; without them, the sides of a plane are not noted.

    Examples
    --------
    >>> from ertis_numba.geometry import observable_angles
    >>> from ertis_numba.settings import Array
    >>> observable_angles(Array()).elevation
    True
    >>> observable_angles(Array(positions_m=((0, 0, 0), (0, 0.01, 0), (0, 0.02, 0)))).elevation
    False
    """
    positions_m = microphones(array).enabled_positions_m
    count = len(positions_m)
    beside_m = positions_m - positions_m.mean(axis=0)  # An array may have lost microphones.
    _, sizes, axes = np.linalg.svd(np.concatenate([beside_m, np.zeros((3, 3))]), full_matrices=False)
    if sizes[0] < _POINT_M:
        which = "one microphone" if count == 1 else f"{count} microphones at the same position"
        return ObservableAngles(
            azimuth=False, elevation=False, note=f"has {which}; its images show ranges but no directions"
        )
    if sizes[1] < _FLAT * sizes[0]:
        return _of_line(axes[0])
    normal = _normal(positions_m)
    if normal is not None and grid is not None:
        heights = unit_vectors(grid.azimuth_rad, grid.elevation_rad) @ normal
        if heights.min() < -_UPRIGHT and heights.max() > _UPRIGHT:
            note = f"{_IN_PLANE}, so it cannot distinguish the two sides of this plane"
            return ObservableAngles(azimuth=True, elevation=True, note=note)
    return ObservableAngles(azimuth=True, elevation=True)


def direction_note(array: Array, grid: DegreesFromRadians, *, is_passive: bool = False) -> str | None:
    """Return a note on directions that an image or a map does not show, or shows elsewhere.

    It names the angles of `observable_angles`, and the limits of the directions: sound from above or below directions
    at one elevation, and from elsewhere than a single direction, appears in these directions. An array with microphones
    in a plane shows sound from behind this plane in front of it.

    Parameters
    ----------
    array : Array
    grid : Grid, or a result with directions
    is_passive : bool
        Note the side of the plane that has no directions. By default, only the sides of grids with directions on both
        are noted, because an emitter sends its call to the side of the directions.

    Returns
    -------
    str or None
        Predicate of the sensor; None without any limit.

    Examples
    --------
    >>> from ertis_numba.geometry import direction_grid, direction_note
    >>> from ertis_numba.settings import Array, Processing
    >>> direction_note(Array(), direction_grid(Processing(directions="3d:1000"))) is None
    True
    >>> direction_note(Array(), direction_grid(Processing(directions="2d:91"))).partition(",")[0]
    'has directions at one elevation'
    """
    seen = observable_angles(array, grid)
    if not (seen.azimuth and seen.elevation):
        return seen.note
    sides = seen.note
    if is_passive and not sides and _normal(microphones(array).enabled_positions_m) is not None:
        sides = f"{_IN_PLANE}, so sound from behind this plane appears in front of it"
    return "; it also ".join(filter(None, (_of_grid(grid), sides))) or None


def require_places(array: Array, sensor: str, *, is_planar: bool) -> None:
    """Raise ArgumentError if an array observes no places of echoes, not even at the elevation of planar images."""
    seen = observable_angles(array)
    if seen.azimuth and (seen.elevation or is_planar):
        return
    remedy = "process with 2d:N directions" if seen.azimuth else "use an array with microphones in a plane"
    raise ArgumentError(f"sensor {sensor} {seen.note}, so its echoes have no places; {remedy}")


def _of_grid(grid: DegreesFromRadians) -> str | None:
    """Return the note on directions at one elevation, or on a single one."""
    azimuth_deg, elevation_deg = grid.azimuth_deg, grid.elevation_deg
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    if np.linalg.norm(directions - directions[0], axis=1).max() < _SAME:
        return (
            f"has one direction, azimuth {azimuth_deg[0]:g}°, elevation {elevation_deg[0]:g}°, so sound from elsewhere "
            "appears there, and too weak; process with more directions to locate it"
        )
    if np.ptp(grid.elevation_rad) == 0:
        return (
            f"has directions at one elevation, {elevation_deg[0]:g}°, so sound from above or below may appear at a "
            "wrong azimuth, and too weak; process with 3d:N directions to locate it"
        )
    return None


def _normal(positions_m: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the unit vector across the plane of microphones, (axis,) float64; None if they lie in no plane."""
    beside_m = np.concatenate([positions_m - positions_m.mean(axis=0), np.zeros((3, 3))])
    _, sizes, axes = np.linalg.svd(beside_m, full_matrices=False)
    return np.asarray(axes[2]) if sizes[2] < _FLAT * sizes[0] else None


def _of_line(axis: NDArray[np.float64]) -> ObservableAngles:
    """Return the angles that microphones along an axis observe."""
    if abs(axis[2]) < _UPRIGHT:
        text = "the elevation is unknown, and the azimuth is right for elevation 0 only"
        text += "; left and right cannot be distinguished" if abs(axis[1]) < _UPRIGHT else ""
        return ObservableAngles(
            azimuth=True, elevation=False, note=f"has its microphones on a horizontal line; {text}", line=axis
        )
    if np.hypot(axis[0], axis[1]) < _UPRIGHT:
        return ObservableAngles(
            azimuth=False,
            elevation=True,
            note="has its microphones on a vertical line; the azimuth is unknown",
            line=axis,
        )
    return ObservableAngles(
        azimuth=False,
        elevation=False,
        note="has its microphones on an inclined line; only the angle to this line is known",
        line=axis,
    )
