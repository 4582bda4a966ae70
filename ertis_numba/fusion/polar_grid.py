"""Cells of fused images: directions around the platform and ranges."""

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import unit_vectors

__all__ = ["PolarGrid", "close_directions"]

Floats = NDArray[np.float64]
Places = NDArray[np.int64]

MAX_CELLS: Final = 4_000_000
_NONE: Final = -1


@dataclass(frozen=True, slots=True, eq=False)
class PolarGrid:
    """Directions all around a point of the platform at ``height_m``, and equally spaced ranges from half a step on.

    The first azimuth is −180° and half a step. ``elevation_rad`` (row,) are equally spaced; one row is a planar image.
    """

    n_azimuths: int
    elevation_rad: Floats
    n_ranges: int
    step_m: float
    height_m: float = 0.0

    @classmethod
    def around(cls, spacing_deg: float, step_m: float, last_m: float, *, is_planar: bool, height_m: float) -> Self:
        """Return a grid of a given spacing of directions and ranges, up to a range, with a limited number of cells."""
        checks.between("spacing_deg", spacing_deg, 0.1, 30.0)
        checks.between("range_step_m", step_m, 1e-3, 1.0)
        n_azimuths = round(360.0 / spacing_deg)
        rows = np.zeros(1)
        if not is_planar:
            n_rows = max(2, round(180.0 / spacing_deg))
            rows = np.radians((np.arange(n_rows) + 0.5) * (180.0 / n_rows) - 90.0)
        grid = cls(n_azimuths, rows, max(1, math.ceil(last_m / step_m)), step_m, height_m)
        if grid.n_cells > MAX_CELLS:
            raise ArgumentError(
                f"the fused image would reach {last_m:.4g} m and have {grid.n_cells} cells, but the limit is "
                f"{MAX_CELLS}; correct the mountings, shorten the ranges, or use a larger spacing_deg or range_step_m"
            )
        return grid

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.n_directions * self.n_ranges

    @property
    def n_directions(self) -> int:
        """Number of directions."""
        return self.n_azimuths * len(self.elevation_rad)

    @property
    def is_planar(self) -> bool:
        """True if all directions lie in the horizontal plane."""
        return len(self.elevation_rad) == 1

    @property
    def range_m(self) -> Floats:
        """Ranges in metres: (range,) float64."""
        return np.asarray((np.arange(self.n_ranges) + 0.5) * self.step_m)

    @property
    def azimuth_rad(self) -> Floats:
        """Azimuth of each direction: (direction,) float64."""
        return np.asarray(np.tile(self._azimuths_rad, len(self.elevation_rad)))

    @property
    def directions(self) -> Floats:
        """Unit vectors of the directions: (direction, axis) float64."""
        return unit_vectors(self.azimuth_rad, self.elevations_rad)

    @property
    def elevations_rad(self) -> Floats:
        """Elevation of each direction: (direction,) float64."""
        return np.asarray(np.repeat(self.elevation_rad, self.n_azimuths))

    @property
    def positions_m(self) -> Floats:
        """Centres of the cells on the platform: (cell, axis) float64, directions first."""
        points_m = self.directions[:, None] * self.range_m[:, None]
        return np.asarray(points_m.reshape(-1, 3) + self.centre_m)

    @property
    def centre_m(self) -> Floats:
        """Centre of the grid on the platform: (axis,) float64."""
        return np.array([0.0, 0.0, self.height_m])

    def cell_of(self, position_m: Floats) -> Places:
        """Return the index of the cell at each position, or -1 outside of the grid: (point,) int64."""
        offset_m = position_m - self.centre_m
        level_m = np.hypot(offset_m[..., 0], offset_m[..., 1])
        distance_m = level_m if self.is_planar else np.hypot(level_m, offset_m[..., 2])
        turn = np.arctan2(offset_m[..., 1], offset_m[..., 0]) / (2 * math.pi) + 0.5
        direction = (turn * self.n_azimuths).astype(np.int64) % self.n_azimuths
        if not self.is_planar:
            row = (np.arctan2(offset_m[..., 2], level_m) / math.pi + 0.5) * len(self.elevation_rad)
            direction += self.n_azimuths * row.astype(np.int64).clip(0, len(self.elevation_rad) - 1)
        step = (distance_m / self.step_m).astype(np.int64)
        return np.where(step < self.n_ranges, direction * self.n_ranges + step, _NONE)

    @property
    def _azimuths_rad(self) -> Floats:
        return np.asarray((np.arange(self.n_azimuths) + 0.5) * (2 * math.pi / self.n_azimuths) - math.pi)


def close_directions(directions: Floats, within_rad: float) -> Places:
    """Return the directions within an angle of each, itself included and as filling: (direction, neighbour)."""
    # Importing SciPy's trees takes a tenth of a second, and no other function needs them.
    from scipy.spatial import KDTree  # noqa: PLC0415

    near = KDTree(directions).query_ball_point(directions, 2 * math.sin(within_rad / 2) + 1e-9)
    most = max(len(each) for each in near)
    found = np.repeat(np.arange(len(directions))[:, None], most, axis=1)
    for row, each in enumerate(near):
        found[row, : len(each)] = each
    return found
