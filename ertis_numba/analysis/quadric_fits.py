"""Quadrics through values at neighbouring directions, whose maxima stay within the cell of a direction."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ertis_numba import kernels

__all__ = ["MAX_RISE_DB", "QuadricFits"]

MAX_RISE_DB = 0.99
"""Largest level of an interpolated maximum in dB, relative to the strongest bin; with rounding, it stays below 1 dB."""

_MAX_GAP_RAD = 2.6  # Neighbours within less than half a turn lie on one side: at the edge of a grid.
_LINE = 0.2  # Ratio of the widths of a direction's neighbours, below which they lie on a line.
_OPPOSITE = -0.87  # Cosine of the angle between two neighbours that lie on opposite sides.
_MAX_BORDERS = 16  # Each shortens an offset to the border with one other cell; most need none, some need two.
_INNER = 0.49  # Share of the distance to the nearest other direction, within which offsets end in their cell.
_BESIDE = 0.75  # Share of an offset within its cell, below which the maximum lies elsewhere.
_WELL_POSED = 0.02  # Least singular value relative to the largest; uniform weights have 0.17 within a grid.
_SAME = 1e-9  # Distance in radians below which two directions are one.
_ONE_SIDED = 0.2  # Sum of the neighbours' offsets relative to that of their lengths; within a grid, it is about 0.
_ONE_SIDED_TERMS = (slice(0, 5), slice(0, 4), slice(0, 2))  # Of x, x², y, y² and xy; the last ones for a line.
_LEAST_WEIGHT = -7.0  # Logarithm of the weight of neighbours far below the direction.
_ROOT = 0.6  # A power of this order is another parabola: that of the logarithm is too steep in the skirt of a lobe.
_OUTSIDE = 0.75  # Distance of a maximum from its direction in spacings, beyond which it may lie outside of the grid.
_MAX_REACH_RAD = 1.0  # Beyond it, the plane that touches the sphere is no approximation.

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class QuadricFits:
    """Fit of a quadric to each direction and its neighbours, over the plane or the line that contains them."""

    # Without neighbours all around, a parabola through two opposite ones remains, or no fit. A cell ends half-way to
    # each other direction of `grid`.

    quadrics: kernels.Quadrics
    width_rad: Floats
    wanted: NDArray[np.int64]
    grid: KDTree
    n_axes_of_grid: int

    @classmethod
    def of(
        cls, directions: Floats, neighbours: NDArray[np.int64], wanted: NDArray[np.int64], weights: Floats | None = None
    ) -> "QuadricFits":
        """Return the fits of some directions of a grid, with squared errors weighted by (place, neighbour)."""
        offsets = directions[neighbours[wanted]] - directions[wanted][:, None]
        _, sizes, axes = np.linalg.svd(np.pad(offsets, ((0, 0), (0, max(0, 3 - offsets.shape[1])), (0, 0))))
        axes = np.ascontiguousarray(axes[:, :2])
        reach = np.linalg.norm(offsets, axis=2).max(axis=1, initial=0.0)
        x, y = np.moveaxis(offsets @ axes.transpose(0, 2, 1), 2, 0)
        is_plane = (sizes[:, 1] > _LINE * sizes[:, 0]) & (offsets.shape[1] > 5) & _are_around(x, y)
        terms = np.stack([x, y, x * x, x * y, y * y], axis=2)
        roots = np.ones_like(x) if weights is None else np.sqrt(weights)
        inverse = np.linalg.pinv(terms * roots[:, :, None]) * roots[:, None]
        is_plane &= _are_well_posed(terms * roots[:, :, None], reach)
        n_axes = np.where(is_plane, 2, 0)
        for place in np.flatnonzero(~is_plane):
            pair = _opposite_pair(offsets[place])
            if pair is not None:
                axes[place, 0], inverse[place] = _line_through(offsets[place], *pair)
                n_axes[place] = 1
        reach = np.where((n_axes > 0) & (reach <= _MAX_REACH_RAD), reach, 0.0)
        distance = np.linalg.norm(offsets, axis=2)
        width_rad = np.where(distance > _SAME, distance, np.inf).min(axis=1, initial=np.inf)
        n_axes = np.where(reach > 0, n_axes, 0)
        n_axes_of_grid = 1 if np.ptp(directions[:, 2]) == 0 else 2
        return cls(
            kernels.Quadrics(axes, inverse, n_axes, reach), width_rad, wanted, KDTree(directions), n_axes_of_grid
        )

    def tops(self, directions: NDArray[np.int64], rises: Floats) -> tuple[Floats, Floats]:
        """Return offsets (place, axis) from directions to the maxima of their quadrics, and the rise there."""
        # Offsets are 0 without a maximum within the distance of the farthest neighbour. `rises` are values minus that
        # here.
        found = np.empty((len(rises), 4))
        kernels.load_points().find_tops(self.quadrics, directions, np.ascontiguousarray(rises, np.float64), found)
        return found[:, :3], found[:, 3]

    def within_cells(
        self, directions: NDArray[np.int64], offset: Floats, *, is_fitted: bool = False
    ) -> tuple[Floats, Floats]:
        """Return offsets shortened to end within their cells, (place, axis), and the width of cells: (place,)."""
        # The width is 0 for directions that are interpolated along all axes of the grid.
        share, width_rad = np.ones(len(offset)), self.width_rad[directions]
        far = np.flatnonzero(np.linalg.norm(offset, axis=1) > _INNER * width_rad)  # Others cross no border.
        here, moved, part = self.grid.data[self.wanted[directions[far]]], offset[far], np.ones(len(far))
        for _ in range(_MAX_BORDERS if len(far) else 0):
            top = here + part[:, None] * moved
            _, nearest = self.grid.query(top / np.linalg.norm(top, axis=1)[:, None])
            other = self.grid.data[nearest] - here
            half, along = 0.5 * (other**2).sum(axis=1), (other * moved).sum(axis=1)
            is_beyond = (part * along > half * (1 + _SAME)) & (half > _SAME**2)  # Equal directions share a cell.
            if not is_beyond.any():
                break
            part[is_beyond] = half[is_beyond] / along[is_beyond]
        share[far] = part
        is_between = (share > _BESIDE) & np.isfinite(width_rad)
        if not is_fitted:
            is_between &= offset.any(axis=1) & (self.quadrics.n_axes[directions] >= self.n_axes_of_grid)
        cut_rad = (1 - share) * np.linalg.norm(offset, axis=1)  # The error is about as large: that of a wider cell.
        return offset * share[:, None], np.where(is_between, np.minimum(math.sqrt(12) * cut_rad, width_rad), width_rad)

    def within_limits(
        self, directions: NDArray[np.int64], neighbours: NDArray[np.int64], offset: Floats
    ) -> tuple[Floats, Floats]:
        """Return offsets that do not leave the grid at its edges, (place, axis), and how far they did: (place,)."""
        offset, beyond_rad = offset.copy(), np.zeros(len(offset))
        for place in np.flatnonzero(self.quadrics.n_axes[directions] < self.n_axes_of_grid):
            inwards = _inwards(self.grid.data[neighbours[place]] - self.grid.data[self.wanted[directions[place]]])
            if inwards is not None:
                beyond_rad[place] = max(0.0, -float(offset[place] @ inwards))
                is_far = beyond_rad[place] > 0.5 * self.width_rad[directions[place]]
                offset[place] = 0.0 if is_far else offset[place] + beyond_rad[place] * inwards
        return offset, beyond_rad

    def are_open(
        self, directions: NDArray[np.int64], neighbours: NDArray[np.int64], rises: Floats | None = None
    ) -> NDArray[np.bool_]:
        """Return True at edges of the grid where the maximum may lie beyond the cell of the direction: (place,)."""
        is_open = np.zeros(len(directions), dtype=np.bool_)
        for place in np.flatnonzero(self.quadrics.n_axes[directions] < self.n_axes_of_grid):
            row = directions[place]
            offsets = self.grid.data[neighbours[place]] - self.grid.data[self.wanted[row]]
            values = None if rises is None else rises[place]
            is_open[place] = _is_open(offsets, values, float(self.width_rad[row]))
        return is_open


def _are_around(x: Floats, y: Floats) -> NDArray[np.bool_]:
    """Return True where neighbours lie all around 0: (place,) bool."""
    distance = np.hypot(x, y)
    angle = np.arctan2(y, x)
    farthest = np.take_along_axis(angle, distance.argmax(axis=1)[:, None], axis=1)
    angle = np.sort(np.where(distance > _SAME, angle, farthest), axis=1)
    gaps = np.diff(angle, axis=1, append=angle[:, :1] + 2 * np.pi)
    return np.asarray(gaps.max(axis=1) < _MAX_GAP_RAD)


def _are_well_posed(terms: Floats, reach: Floats) -> NDArray[np.bool_]:
    """Return True where values determine all coefficients of a quadric: (place,) bool."""
    unit = np.where(reach > 0, reach, 1.0)[:, None]
    scale = np.concatenate([unit, unit, unit**2, unit**2, unit**2], axis=1)
    sizes = np.linalg.svd(terms / scale[:, None], compute_uv=False)
    return np.asarray(sizes[:, -1] > _WELL_POSED * sizes[:, 0])


def _opposite_pair(offsets: Floats) -> tuple[int, int] | None:
    """Return the nearest two neighbours on opposite sides; None if there are none."""
    distance = np.linalg.norm(offsets, axis=1)
    is_other = distance > _SAME
    unit = offsets / np.where(is_other, distance, 1.0)[:, None]
    sums = np.where(unit @ unit.T < _OPPOSITE, distance[:, None] + distance, np.inf)
    first, second = np.unravel_index(int(sums.argmin()), sums.shape)
    return (int(first), int(second)) if np.isfinite(sums[first, second]) else None


def _line_through(offsets: Floats, first: int, second: int) -> tuple[Floats, Floats]:
    """Return the axis through two neighbours, and the matrix of the parabola through them and 0: (5, neighbour)."""
    axis = offsets[first] - offsets[second]
    axis /= np.linalg.norm(axis)
    a, b = offsets[[first, second]] @ axis
    inverse = np.zeros((5, len(offsets)))
    inverse[0, [first, second]] = np.array([b * b, -a * a]) / (a * b * (b - a))
    inverse[2, [first, second]] = np.array([-b, a]) / (a * b * (b - a))
    return axis, inverse


def _inwards(offsets: Floats) -> Floats | None:
    """Return the unit vector away from the edge of the grid; None if other directions lie on both sides."""
    inwards = offsets.sum(axis=0)
    size = float(np.linalg.norm(inwards))
    is_one_sided = size > _ONE_SIDED * float(np.linalg.norm(offsets, axis=1).sum())
    return inwards / size if is_one_sided else None


def _is_open(offsets: Floats, rises: Floats | None, width_rad: float) -> bool:
    """Return True unless the maximum of values on one side of a direction lies in the cell of the direction."""
    inwards = _inwards(offsets)
    if inwards is None:
        return False
    if rises is None:
        return True
    distance = np.linalg.norm(offsets, axis=1)
    is_other = distance > _SAME
    offsets = offsets[is_other]
    x = offsets @ inwards
    beside = offsets - x[:, None] * inwards
    y = beside @ np.linalg.svd(beside)[2][0]
    terms = np.stack([x, x * x, y, y * y, x * y], axis=1) / distance.max() ** np.array([1, 2, 1, 2, 2])
    used = next((each for each in _ONE_SIDED_TERMS if _is_determined(terms[:, each])), None)
    if used is None:
        return True
    values = np.stack([rises[is_other], np.expm1(_ROOT * rises[is_other])], axis=1)
    weights = np.exp(0.5 * np.maximum(rises[is_other], _LEAST_WEIGHT))[:, None]  # Skirts are no parabola.
    slope, curve = np.linalg.lstsq(weights * terms[:, used], weights * values, rcond=None)[0][:2]
    return bool(((curve >= 0) | (slope < _OUTSIDE * width_rad / distance.max() * 2 * curve)).any())


def _is_determined(terms: Floats) -> bool:
    """Return True if values determine the coefficients of all terms, (neighbour, term)."""
    sizes = np.linalg.svd(terms, compute_uv=False)
    return len(terms) >= terms.shape[1] and bool(sizes[-1] > _WELL_POSED * sizes[0])
