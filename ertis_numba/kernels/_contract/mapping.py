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
    """Find the first occupied cell in each direction.

    Places outside of the map have the values of the cells at its edge.

    Parameters
    ----------
    log_odds : (layer, row, column) float32
    place : (axis,) float64
        Start of the directions.
    direction : (direction, axis) float64
        Unit vectors.
    step : float
        Spacing of the ranges in cells; the first one is half a step.
    wall : float32
        Log-odds above which a cell is occupied.
    n_steps : int
        Number of ranges.
    out : (direction,) int64
        Number of ranges before the first occupied cell.
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
    """Add the density of normally distributed echoes to the cells around them.

    Parameters
    ----------
    place : (echo, axis) float64
        Means.
    precision : (echo, axis, axis) float64
        Inverse covariances.
    reach : (echo, axis) float64
        Distances along the axes within which cells change.
    peak : (echo,) float64
        Density at the mean.
    most : (echo,) float64
        Limit of the density.
    out : (layer, row, column) float32
        Sum, to which the densities are added.
    """

    def __call__(
        self, place: Doubles, precision: Doubles, reach: Doubles, peak: Doubles, most: Doubles, out: Real
    ) -> None: ...


class AddEvidence(Protocol):
    """Add the evidence of one pulse to a map.

    Parameters
    ----------
    occupied : (layer, row, column) float32
        Evidence for occupied cells.
    touched : float32
        Evidence from which a cell is not free.
    most : float32
        Limit of the evidence for occupied cells.
    free : (elevation, azimuth, range) float32
        Evidence for free cells, which lowers their log-odds. The magnitude of a negative value lowers the log-odds of
        occupied cells, but not below 0.
    place : (axis,) float64
        Centre of the polar grid.
    rotation : (axis, axis) float64
        Rotation from the frame of the polar grid to that of the map.
    step : float
        Spacing of the ranges in cells.
    near : float
        Distance in cells within which cells are free.
    near_free : float32
        Evidence for free cells there.
    limit : float32
        Limit of the log-odds of the map.
    out : (layer, row, column) float32
        Log-odds of the map, which change.
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
