"""Extent of the directions that are searched, in units of the array's resolution."""

from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

__all__ = ["ScanExtent", "ScanMesh", "is_level"]

_GAP: Final = 4.0  # An edge longer than this, relative to the median, spans directions that are not searched.
_BATCH: Final = 4096  # Pieces of the mesh that are processed together, which limits the memory.

Floats = NDArray[np.float64]
Places = NDArray[np.intp]


class ScanExtent(NamedTuple):
    """Sizes of a set of directions, measured by how much the whitened wave of unit power changes between them."""

    n_parts: float  # Euler characteristic: 1 if connected without holes, or number of separate directions
    length: float  # on a line, or half of the perimeter of an area
    area: float  # 0 on a line


def is_level(directions: NDArray[np.float64]) -> bool:
    """Return True if all directions, unit vectors (direction, axis), have one elevation."""
    return bool(np.ptp(directions[:, 2]) < 1e-9)


class ScanMesh:
    """Mesh of unit vectors (direction, axis): triangles on a sphere, or steps along a line."""

    def __init__(self, directions: Floats, delay_s: Floats) -> None:
        self._delay_s = delay_s
        self._n_parts = 1.0 if len(directions) >= 4 else float(len(directions))
        self._triangles, self._steps = np.zeros((0, 3), np.intp), np.zeros((0, 2), np.intp)
        if len(directions) < 4:
            return
        if is_level(directions):
            order = np.argsort(np.arctan2(directions[:, 1], directions[:, 0]))
            pairs = np.stack([order[:-1], order[1:]], axis=1)
            sizes = np.linalg.norm(directions[pairs[:, 1]] - directions[pairs[:, 0]], axis=1)
            self._steps = pairs[sizes <= _GAP * np.median(sizes)]
        else:
            self._triangles, self._steps = _area(directions)

    def extent(self, omega_rad_s: float, whitening: Floats | None = None) -> ScanExtent:
        """Return the extent at an angular frequency; whitening is (mode, mic), None if noise is white.

        With the whitened wave u and its changes ``∂u`` between two near directions, their squared distance is ``∂u^H (I
        − u u^H / u^H u) ∂u / u^H u``. Without whitening, it is ω² times the variance of the changes of the delays over
        the microphones.
        """
        area = length = 0.0
        for first in range(0, len(self._triangles), _BATCH):
            metric = self._metric(self._triangles[first : first + _BATCH], omega_rad_s, whitening)
            area += float(np.sqrt(np.maximum(np.linalg.det(metric), 0)).sum()) / 2
        for first in range(0, len(self._steps), _BATCH):
            metric = self._metric(self._steps[first : first + _BATCH], omega_rad_s, whitening)
            length += float(np.sqrt(np.maximum(metric[:, 0, 0], 0)).sum())
        return ScanExtent(self._n_parts, length / 2 if len(self._triangles) else length, area)

    def similarity(self, omega_rad_s: float, spacing_rad_s: float, n: int, whitening: Floats | None = None) -> Floats:
        """Return the mean similarity of a direction's waves at equally spaced frequencies: (n,).

        The similarity of the whitened waves u at the first frequency and v at another is the squared cosine of their
        angle, ``|u^H v|² / (u^H u · v^H v)``. It is less than 1 for directions whose sound takes a considerable time to
        cross the array.
        """
        waves = np.exp(-1j * (omega_rad_s + spacing_rad_s * np.arange(n)[:, None, None]) * self._delay_s)
        if whitening is not None:
            waves = waves @ whitening.T
        size = (np.abs(waves) ** 2).sum(axis=2)
        products = np.abs((waves[0].conj() * waves).sum(axis=2)) ** 2
        return np.asarray((products / (size[0] * size)).mean(axis=1))

    def _metric(self, corners: Places, omega_rad_s: float, whitening: Floats | None) -> Floats:
        """Return the products of the changes from the first corner to the others: (piece, other, other)."""
        delay_s = self._delay_s[corners]
        slopes_s = delay_s[:, 1:] - delay_s[:, :1]
        if whitening is None:  # The phases of the wave cancel.
            wave = np.ones((len(corners), delay_s.shape[2]), np.complex128)
            changes = omega_rad_s * slopes_s * wave[:, None]
        else:
            wave = np.exp(-1j * omega_rad_s * delay_s.mean(axis=1))
            changes = omega_rad_s * slopes_s * wave[:, None] @ whitening.T
            wave = wave @ whitening.T
        along = (changes * wave.conj()[:, None]).sum(axis=2)
        size = (np.abs(wave) ** 2).sum(axis=1)[:, None, None]
        products = changes @ changes.conj().transpose(0, 2, 1) - along[:, :, None] * along[:, None].conj() / size
        return np.asarray(products.real / size)


def _area(directions: Floats) -> tuple[Places, Places]:
    """Return the triangles between directions on a sphere, and the steps along their border."""
    triangles = scipy.spatial.ConvexHull(directions).simplices
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    long = np.linalg.norm(directions[edges[..., 0]] - directions[edges[..., 1]], axis=2).max(axis=1)
    kept = long <= _GAP * np.median(long)
    pairs, counts = np.unique(edges[kept].reshape(-1, 2), axis=0, return_counts=True)
    return triangles[kept].astype(np.intp), pairs[counts == 1].astype(np.intp)
