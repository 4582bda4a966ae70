"""Energyscapes as grey pictures, with one pixel per direction and range or per direction."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ertis_numba.analysis.levels import below_strongest_db
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import FAR, spacing_rad, unit_vectors, unrolled_rad

__all__ = ["DYNAMIC_RANGE_DB", "GreyImage"]

DYNAMIC_RANGE_DB = 40.0
"""Level relative to the strongest at which a pixel is black."""
_MAX_PIXELS = 1000  # Limit along each side of a map.


class GreyImage:
    """Converter of images with the same directions to pictures."""

    # Planar images show azimuth and range from below; others azimuth and elevation, with the maximum over range.

    def __init__(self, image: Energyscape) -> None:
        self._columns = np.argsort(-unrolled_rad(image.azimuth_rad), kind="stable")
        self._map = None if image.is_planar else _map(image)

    def __call__(self, amplitude: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the picture of amplitudes, (direction, range): (row, column) uint8, 255 for the strongest."""
        shown = amplitude if self._map is None else amplitude.max(axis=1, keepdims=True)
        level_db = below_strongest_db(shown, DYNAMIC_RANGE_DB)
        grey = np.rint(255 * (1 + level_db / DYNAMIC_RANGE_DB)).astype(np.uint8)
        if self._map is None:
            return np.ascontiguousarray(grey[self._columns].T[::-1])
        return np.append(grey[:, 0], np.uint8(0))[self._map]


def _map(image: Energyscape) -> NDArray[np.int64]:
    """Return the direction of each pixel, or the number of directions for pixels without one: (row, column) int64."""
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    tree = KDTree(directions)
    apart_rad = spacing_rad(directions) or math.pi
    axes = []
    for angle_rad in (unrolled_rad(image.azimuth_rad, 1.5 * apart_rad), image.elevation_rad):
        span_rad = float(np.ptp(angle_rad))
        count = min(_MAX_PIXELS, 1 + round(span_rad / max(apart_rad, span_rad / _MAX_PIXELS)))
        axes.append(np.linspace(angle_rad.max(), angle_rad.min(), count))
    looks = unit_vectors(*np.meshgrid(*axes))
    distance, nearest = tree.query(looks)
    return np.where(distance > FAR * apart_rad, len(directions), nearest).astype(np.int64)
