"""Grid of cells that grows with the explored space."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import MAX_CELLS

__all__ = ["CellGrid", "Window"]

Counts = NDArray[np.int64]
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

_BLOCK: Final = np.array([64, 64, 16])  # The grid grows by whole blocks of cells, so that it is copied rarely.

_MOVED_M: Final = 0.1  # Motion of a sensor after which it sees from a new viewpoint.


class Window(NamedTuple):
    """Part of a grid as a view; arrays are (layer, row, column)."""

    log_odds: Singles  # view of the grid
    first: Counts  # column, row and layer of the first cell, from the world's origin
    cell_m: float  # side of the cells
    is_planar: bool  # one layer, all places in its middle
    before: Singles  # log-odds before the pulses from the present viewpoint
    shown: Singles  # largest evidence of one of these pulses for an occupied cell

    def cells_of(self, place_m: Floats) -> Floats:
        """Return places in cells from the centre of the first cell: (..., axis) float64."""
        cells = place_m / self.cell_m - self.first - 0.5
        if self.is_planar:
            cells[..., 2] = 0.0
        return np.asarray(cells)


class CellGrid:
    """Log-odds of square or cubic cells, whose corners are multiples of their side from the world's origin."""

    def __init__(self, cell_m: float, n_dimensions: int = 2, height_m: tuple[float, float] = (-np.inf, np.inf)) -> None:
        self._cell_m, self._n_dimensions, self._height_m = cell_m, n_dimensions, height_m
        self._first = np.zeros(3, np.int64)  # Column, row and layer of the first cell, from the world's origin.
        # Log-odds, those before the present viewpoint, and the largest evidence of a pulse from it.
        self._cells: Singles = np.zeros((3, 0, 0, 0), np.float32)
        self._viewpoint: tuple[Floats, Floats] | None = None

    @property
    def log_odds(self) -> Singles:
        """Log-odds of all cells: (layer, row, column) float32."""
        return np.asarray(self._cells[0])

    def decay(self, factor: float) -> None:
        """Multiply all evidence by a factor."""
        self._cells *= np.float32(factor)

    def view_from(self, place_m: Floats, rotation: Floats, radius_m: float) -> None:
        """Begin a new viewpoint if sensors, within radius_m of the platform, have moved away from the present."""
        # Ghosts repeat at the same places until the sensors move, so pulses from one viewpoint are one observation.
        if self._viewpoint is not None:
            turned = math.sqrt(max(0.0, 3.0 - float(np.sum(rotation * self._viewpoint[1]))))  # Chord of the turn.
            if float(np.linalg.norm(place_m - self._viewpoint[0])) + radius_m * turned < _MOVED_M:
                return
        self._viewpoint = place_m.copy(), rotation.copy()
        self._cells[1], self._cells[2] = self._cells[0], 0.0

    def window(self, centre_m: Floats, radius_m: float) -> Window:
        """Return the square or cube around a place; the grid grows, up to an ArgumentError for too many cells."""
        low_m, high_m = centre_m - radius_m, centre_m + radius_m
        low_m[2], high_m[2] = np.clip([low_m[2], high_m[2]], *self._height_m)
        low, high = np.floor(low_m / self._cell_m).astype(np.int64), np.ceil(high_m / self._cell_m).astype(np.int64)
        high[2] = max(high[2], low[2] + 1)
        if self._n_dimensions == 2:
            low[2], high[2] = 0, 1
        self._grow(low, high)
        layers, rows, columns = (
            slice(a, b) for a, b in zip((low - self._first)[::-1], (high - self._first)[::-1], strict=True)
        )
        log_odds, before, shown = self._cells[:, layers, rows, columns]
        return Window(log_odds, low, self._cell_m, self._n_dimensions == 2, before, shown)

    def _grow(self, low: Counts, high: Counts) -> None:
        size = np.array(self.log_odds.shape[::-1])
        if size.all() and (low >= self._first).all() and (high <= self._first + size).all():
            return
        if size.all():
            low, high = np.minimum(low, self._first), np.maximum(high, self._first + size)
        block = _BLOCK if self._n_dimensions == 3 else np.append(_BLOCK[:2], 1)
        first, end = low // block * block, -(-high // block) * block
        sizes = (end - first).tolist()
        n_cells = int(np.prod(sizes))
        if n_cells > MAX_CELLS:
            sides = " by ".join(f"{count * self._cell_m:.0f}" for count in sizes[: self._n_dimensions])
            raise ArgumentError(
                f"the map would have {n_cells} cells ({sides} m), but the limit is {MAX_CELLS}; use larger cells "
                "(cell_m), or poses closer together"
            )
        grown = np.zeros((3, *sizes[::-1]), np.float32)
        column, row, layer = (self._first - first).tolist()
        grown[:, layer : layer + size[2], row : row + size[1], column : column + size[0]] = self._cells
        self._first, self._cells = first, grown

    def used(self) -> tuple[Singles, tuple[float, ...]]:
        """Return a copy of the smallest part with all known cells, and its outer corner (x, y) or (x, y, z)."""
        known = [np.flatnonzero(self.log_odds.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
        if not len(known[0]):
            known = [np.zeros(1, np.int64)] * 3
        parts = tuple(slice(places[0], places[-1] + 1) for places in known)
        found = self.log_odds[parts] if self.log_odds.size else np.zeros((1, 1, 1), np.float32)
        first = self._first + [part.start for part in parts[::-1]]
        origin_m = (first * self._cell_m).tolist()[: self._n_dimensions]
        return (found[0] if self._n_dimensions == 2 else found).copy(), tuple(origin_m)
