"""Rows of a planar array: lines of microphones whose beams are summed first; see docs/explanation/accuracy.md."""

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["LEAST_PER_ROW", "Rows", "aligned_axes", "rows_of", "seen_from_rows"]

LEAST_PER_ROW = 4
"""Mean number of microphones per row, below which an array has no rows."""

_WITHIN_M = 1e-5  # Microphones of a row deviate from its line by less. The error model includes it.
_NEAREST = 6  # Neighbours of a microphone whose directions may be those of rows.
_STARTS = 5  # Microphones from which rows are sought, because some may have no neighbour in their row.
_FIRST_PASS = 0.1  # A row's microphones deviate by less than this share of the pitch before its line is fitted.
_NEAREST_SHARE = 0.01  # Least distance of a row, relative to the range, of points beyond the unit circle.
_MAX_ARRAYS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Rows along one axis of an aperture: ``number`` (mic,) of each microphone's row, and ``across_m`` (row,)."""

    along: int
    number: NDArray[np.intp]
    across_m: NDArray[np.float64]
    deviation_m: float

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.across_m)

    @property
    def mics(self) -> list[NDArray[np.intp]]:
        """Microphones of each row."""
        return [np.flatnonzero(self.number == row) for row in range(len(self))]

    @property
    def most(self) -> int:
        """Largest number of microphones of a row."""
        return int(np.bincount(self.number).max())


def rows_of(positions_m: NDArray[np.float64]) -> Rows | None:
    """Return the rows of positions in the plane of an array, (mic, 2), along the axis with fewer; None if too many."""
    return _rows_of(np.ascontiguousarray(positions_m).tobytes())


@functools.lru_cache(maxsize=_MAX_ARRAYS)
def _rows_of(given: bytes) -> Rows | None:
    positions_m = np.frombuffer(given).reshape(-1, 2)
    found = min((_rows_along(positions_m, along) for along in (0, 1)), key=len)
    return found if LEAST_PER_ROW * len(found) <= len(positions_m) else None


def _rows_along(positions_m: NDArray[np.float64], along: int) -> Rows:
    across_m = positions_m[:, 1 - along]
    order = np.argsort(across_m, kind="stable")
    number = np.empty(len(order), dtype=np.intp)
    number[order] = np.concatenate([[0], np.cumsum(np.diff(across_m[order]) > _WITHIN_M)])
    means_m = np.bincount(number, across_m) / np.bincount(number)
    return Rows(along, number, means_m, float(np.sqrt(np.mean((across_m - means_m[number]) ** 2))))


def seen_from_rows(
    points: NDArray[np.float64], rows: Rows, range_m: float, *, sound_speed_m_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the directions of points (point, axis) along each row, and the delays of the rows in s: (point, row).

    Seen from a row at y, a source in direction (u, v) at range r lies at ``r' = √(r² − 2 r v y + y²)`` from the middle
    of the row, in direction ``u r / r'`` along it. For plane waves, this is u.
    """
    u, v, y = points[:, rows.along], points[:, 1 - rows.along], rows.across_m
    if math.isinf(range_m):
        return np.repeat(u[:, None], len(y), axis=1), -np.outer(v, y) / sound_speed_m_s
    bent_m = y**2 - 2 * range_m * np.outer(v, y)
    away_m = np.sqrt(np.maximum(range_m**2 + bent_m, (_NEAREST_SHARE * range_m) ** 2))
    return u[:, None] * range_m / away_m, bent_m / (away_m + range_m) / sound_speed_m_s


def aligned_axes(positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the axes (axis, 2) along and across the rows of positions (mic, 2), longest first; else the given axes."""
    best, fewest = None, len(positions_m) // LEAST_PER_ROW + 1
    for mic in np.unique(np.linspace(0, len(positions_m) - 1, _STARTS).astype(np.intp)):
        away_m = positions_m - positions_m[mic]
        distance_m = np.hypot(*away_m.T)
        for other in np.argsort(distance_m, kind="stable")[1 : 1 + _NEAREST]:
            if not distance_m[other]:
                continue
            axes = _axes_of(away_m, away_m[other], _FIRST_PASS * distance_m[other])
            count = len(_rows_along(positions_m @ axes.T, 0))
            if count < fewest:
                best, fewest = axes, count
    if best is None:
        return np.eye(2)
    extent_m = np.ptp(positions_m @ best.T, axis=0)
    return best[::-1] if extent_m[1] > extent_m[0] * (1 + 1e-9) else best


def _axes_of(away_m: NDArray[np.float64], towards_m: NDArray[np.float64], within_m: float) -> NDArray[np.float64]:
    """Return the axes along and across a row through the origin, fitted to all of its microphones."""
    x, y = towards_m / math.hypot(*towards_m)
    row_m = away_m[np.abs(away_m @ np.array([-y, x])) < within_m]
    far_m = row_m[np.argmax(np.abs(row_m @ np.array([x, y])))]
    x, y = far_m / math.hypot(*far_m)
    if (x, y) < (0.0, 0.0):
        x, y = -x, -y
    return np.array([[x, y], [-y, x]])
