"""Occupancy maps: log-odds of the cells of a plane or of a space in the world."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames._replacing import replaced

__all__ = ["FREE_BELOW", "MAX_CELLS", "OCCUPIED_ABOVE", "OccupancyMap"]

OCCUPIED_ABOVE: Final = 0.65
"""Probability above which a cell is occupied, as for map_server of ROS."""
FREE_BELOW: Final = 0.196
"""Probability below which a cell is free, as for map_server of ROS."""
MAX_CELLS: Final = 64_000_000
_MAX_LOG_ODDS: Final = 50.0  # Beyond it, float32 rounds probabilities to 0 or 1 in any case.


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyMap:
    """Occupancy of square cells in the horizontal plane of the world frame, or of cubic cells in space.

    Attributes
    ----------
    log_odds : (row, column) or (layer, row, column) float32
        Natural logarithm of p / (1 − p), where p is the probability that the cell is occupied; 0 is unknown. Layers
        increase along z, rows along y, and columns along x.
    origin_m : (x, y) or (x, y, z)
        Outer corner of the first cell in metres.
    cell_m : float
        Side of the cells in metres.
    n_groups : int, default 0
        Number of groups of images in the map.
    time_ns : int, default 0
        Time of the last group in nanoseconds since 1970-01-01 UTC; 0 if it is unknown.

    Raises
    ------
    ArgumentError
        There is no cell, or too many, the log-odds are not finite, or an attribute is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> import ertis_numba as ertis
    >>> found = ertis.OccupancyMap(np.array([[0.0, 2.0, -2.0]]), (1.0, 0.0), 0.1)
    >>> found.is_occupied.tolist(), found.is_free.tolist()
    ([[False, True, False]], [[False, False, True]])
    >>> found.occupied_m.round(2).tolist()
    [[1.15, 0.05]]
    >>> voxels = ertis.OccupancyMap(np.full((1, 1, 1), 2.0), (0.0, 0.0, 1.0), 0.1)
    >>> voxels.n_dimensions, voxels.occupied_m.round(2).tolist()
    (3, [[0.05, 0.05, 1.05]])
    """

    log_odds: NDArray[np.float32]
    origin_m: tuple[float, ...]
    cell_m: float
    n_groups: int = 0
    time_ns: int = 0

    def __post_init__(self) -> None:
        log_odds = np.asarray(self.log_odds)
        if log_odds.ndim not in {2, 3} or not log_odds.size or log_odds.dtype.kind not in "fiu":
            raise ArgumentError(
                f"log_odds has shape {log_odds.shape} and type {log_odds.dtype}; pass numbers of shape (row, column) "
                "or (layer, row, column)"
            )
        if log_odds.size > MAX_CELLS:
            raise ArgumentError(f"log_odds has {log_odds.size} cells; the limit is {MAX_CELLS}")
        checks.finite_array("log_odds", log_odds)
        checks.shape("origin_m", np.shape(self.origin_m), (log_odds.ndim,))
        limited = np.clip(log_odds, -_MAX_LOG_ODDS, _MAX_LOG_ODDS)
        object.__setattr__(self, "log_odds", limited.astype(np.float32))
        object.__setattr__(self, "origin_m", tuple(checks.finite("origin_m", edge_m) for edge_m in self.origin_m))
        object.__setattr__(self, "cell_m", checks.between("cell_m", self.cell_m, 1e-3, 10.0))
        checks.integer("n_groups", self.n_groups, 0)
        checks.integer("time_ns", self.time_ns, -(2**63), 2**63 - 1)

    @property
    def n_dimensions(self) -> int:
        """Number of dimensions: 2 for a plane, 3 for a space."""
        return self.log_odds.ndim

    @property
    def probability(self) -> NDArray[np.float32]:
        """Probability that each cell is occupied, in the shape of ``log_odds``: float32; 0.5 is unknown."""
        return np.asarray(1 / (1 + np.exp(-self.log_odds)), np.float32)

    @property
    def is_occupied(self) -> NDArray[np.bool_]:
        """Cells whose probability is above 0.65, in the shape of ``log_odds``: bool."""
        return np.asarray(self.probability > OCCUPIED_ABOVE)

    @property
    def is_free(self) -> NDArray[np.bool_]:
        """Cells whose probability is below 0.196, in the shape of ``log_odds``: bool."""
        return np.asarray(self.probability < FREE_BELOW)

    @property
    def occupied_m(self) -> NDArray[np.float64]:
        """Centres of the occupied cells in metres: (cell, 2) or (cell, 3) float64, row by row."""
        places = np.argwhere(self.is_occupied)[:, ::-1]
        return np.asarray(places * self.cell_m + self.cell_m / 2 + np.array(self.origin_m))

    @property
    def limits_m(self) -> tuple[tuple[float, float], ...]:
        """Limits of the map along x, y, and z if it has layers, in metres."""
        sizes = self.log_odds.shape[::-1]
        return tuple((edge_m, edge_m + size * self.cell_m) for edge_m, size in zip(self.origin_m, sizes, strict=True))

    def log_odds_at(self, position_m: ArrayLike) -> NDArray[np.float32]:
        """Return the log-odds of the cells at positions, 0 outside of the map.

        Parameters
        ----------
        position_m : (..., 2) or (..., 3) array_like
            Positions in metres, with as many coordinates as the map has dimensions.

        Returns
        -------
        (...) float32

        Raises
        ------
        ArgumentError
            The positions have another number of coordinates, or are not finite.
        """
        place_m = np.asarray(position_m, np.float64)
        if not place_m.ndim or place_m.shape[-1] != self.n_dimensions:
            names = "x and y" if self.n_dimensions == 2 else "x, y and z"
            raise ArgumentError(f"position_m has shape {place_m.shape}; use {names} along the last axis")
        checks.finite_array("position_m", place_m)
        place = np.floor((place_m - np.array(self.origin_m)) / self.cell_m)[..., ::-1]
        is_inside = ((place >= 0) & (place < self.log_odds.shape)).all(axis=-1)
        inside = np.where(is_inside[..., None], place, 0).astype(np.int64)
        return np.where(is_inside, self.log_odds[tuple(np.moveaxis(inside, -1, 0))], np.float32(0))

    def replace(self, **changes: Any) -> "OccupancyMap":
        """Return a copy with some fields changed.

        Parameters
        ----------
        **changes
            New values of fields, by name.

        Raises
        ------
        ArgumentError
            There is no such field, or a value cannot be used.
        """
        return replaced("an occupancy map", self, changes)
