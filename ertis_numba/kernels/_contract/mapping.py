"""Contracts of the kernels of occupancy maps, for one thread.

Maps are (layer, row, column); a plane has one layer. Places are x, y and z in cells from the centre of the first cell.
Directions and ranges are those of a polar grid around the platform: rows of equally spaced elevations from −90° to 90°,
or one row, of equally spaced azimuths from −180°.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.arrays import Real

__all__ = ["MappingKernels"]

Counts = NDArray[np.int64]
Doubles = NDArray[np.float64]


class FindWalls(Protocol):
    """Count the ranges, from half a step on, before the first cell above ``wall`` in each direction: (direction,).

    ``place`` and ``step`` are in cells. Places outside of the map have the values of the cells at its edge.
    """

    def __call__(
        self,
        log_odds: Real,
        place: Doubles,
        direction: Doubles,
        step: float,
        wall: np.float32,
        n_steps: int,
        out: Counts,
    ) -> None: ...


class SpreadEchoes(Protocol):
    """Add the density of normally distributed echoes to the cells (layer, row, column) around them.

    ``place`` (echo, axis) are means, ``precision`` inverse covariances, ``reach`` the distances within which cells
    change, ``peak`` the density at the mean, and ``most`` the limit of the density.
    """

    def __call__(
        self, place: Doubles, precision: Doubles, reach: Doubles, peak: Doubles, most: Doubles, out: Real
    ) -> None: ...


class AddEvidence(Protocol):
    """Add the evidence of one pulse to the log-odds of a map, (layer, row, column), within ±``limit``.

    Evidence ``occupied`` of cells is limited to ``most``; from ``touched`` on, a cell is not free. ``free`` (elevation,
    azimuth, range) lowers log-odds; the magnitude of a negative value lowers those of occupied cells, but not below 0.
    ``place`` and ``rotation`` lead from the polar grid to the map; ``step`` and ``near``, within which ``near_free``
    counts, are in cells.
    """

    def __call__(
        self,
        occupied: Real,
        touched: np.float32,
        most: np.float32,
        free: Real,
        place: Doubles,
        rotation: Doubles,
        step: float,
        near: float,
        near_free: np.float32,
        limit: np.float32,
        out: Real,
    ) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class MappingKernels:
    """Kernels of occupancy maps of one device, all for one thread."""

    find_walls: FindWalls
    spread_echoes: SpreadEchoes
    add_evidence: AddEvidence
