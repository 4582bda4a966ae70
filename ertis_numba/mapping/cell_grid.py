"""Grid of cells that grows with the explored area."""

from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError
from ertis_numba.frames import MAX_CELLS

__all__ = ["CellGrid", "Window"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

_BLOCK: Final = 64  # The grid grows by whole blocks of cells, so that it is copied rarely.


class Window(NamedTuple):
    """Part of a grid as a view.

    Attributes
    ----------
    log_odds : (row, column) float32
        View of the grid.
    x_m, y_m : (column,) and (row,) float64
        Centres of the cells.
    """

    log_odds: Singles
    x_m: Floats
    y_m: Floats

    def around(self, place_m: Floats, radius_m: float) -> Self:
        """Return the part of the window within a distance along both axes; it may be empty."""
        columns, rows = (
            slice(*np.searchsorted(centre_m, [place - radius_m, place + radius_m]).tolist())
            for centre_m, place in zip((self.x_m, self.y_m), place_m.tolist(), strict=True)
        )
        return self._replace(log_odds=self.log_odds[rows, columns], x_m=self.x_m[columns], y_m=self.y_m[rows])


class CellGrid:
    """Log-odds of square cells, whose corners are multiples of their side from the world's origin.

    Parameters
    ----------
    cell_m : float
        Side of the cells.
    """

    def __init__(self, cell_m: float) -> None:
        self._cell_m = cell_m
        self._first = np.zeros(2, np.int64)  # Column and row of the first cell, counted from the world's origin.
        self.log_odds: Singles = np.zeros((0, 0), np.float32)

    @property
    def origin_m(self) -> tuple[float, float]:
        """Outer corner of the first cell."""
        x_m, y_m = (self._first * self._cell_m).tolist()
        return x_m, y_m

    def window(self, centre_m: Floats, radius_m: float) -> Window:
        """Return the square around a place, for which the grid grows if necessary.

        Raises
        ------
        ArgumentError
            The grid would have too many cells.
        """
        low = np.floor((centre_m - radius_m) / self._cell_m).astype(np.int64)
        high = np.ceil((centre_m + radius_m) / self._cell_m).astype(np.int64)
        self._grow(low, high)
        columns, rows = (slice(a, b) for a, b in zip(low - self._first, high - self._first, strict=True))
        x_m, y_m = ((np.arange(a, b) + 0.5) * self._cell_m for a, b in zip(low.tolist(), high.tolist(), strict=True))
        return Window(self.log_odds[rows, columns], x_m, y_m)

    def _grow(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        size = np.array(self.log_odds.shape[::-1])
        if size.all() and (low >= self._first).all() and (high <= self._first + size).all():
            return
        if size.all():
            low, high = np.minimum(low, self._first), np.maximum(high, self._first + size)
        first, end = low // _BLOCK * _BLOCK, -(-high // _BLOCK) * _BLOCK
        n_columns, n_rows = (end - first).tolist()
        if n_rows * n_columns > MAX_CELLS:
            raise ArgumentError(
                f"the map would have {n_rows * n_columns} cells, {n_columns * self._cell_m:.0f} by "
                f"{n_rows * self._cell_m:.0f} m; give a larger cell_m, or poses closer together, for at most "
                f"{MAX_CELLS} cells"
            )
        grown = np.zeros((n_rows, n_columns), np.float32)
        column, row = (self._first - first).tolist()
        grown[row : row + size[1], column : column + size[0]] = self.log_odds
        self._first, self.log_odds = first, grown

    def used(self) -> tuple[Singles, tuple[float, float]]:
        """Return a copy of the smallest part with all known cells, and its outer corner."""
        rows, columns = (np.flatnonzero(self.log_odds.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return np.zeros((1, 1), np.float32), self.origin_m
        first = self._first + np.array([columns[0], rows[0]])
        x_m, y_m = (first * self._cell_m).tolist()
        return self.log_odds[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].copy(), (x_m, y_m)
