"""From energyscapes to point clouds, fast enough to do so with every image."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.analysis.detect import neighbours_of, spacing_of
from ertis_numba.analysis.peak_interpolation import PeakInterpolator
from ertis_numba.analysis.side_lobes import side_lobe_floor
from ertis_numba.analysis.uncertainty import PositionUncertainty
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.geometry import Grid, direction_grid, unit_vectors
from ertis_numba.settings import Settings

__all__ = ["PointExtractor"]

_BINS_OF_POINT = 64
"""Of noise alone, so many bins are looked at for each point that is wanted, and not a third of the image."""
_THINNED = 16  # ranges of which one is looked at to tell how strong those are


class PointExtractor:
    """Finds the local maxima of images, with tables that are made here, once for a grid.

    A point is a local maximum over directions and ranges that is above what the side lobes of the strongest
    reflector of about the same range can be. Position and energy are interpolated by parabolas through the logarithm
    of the energy, as `ertis_numba.find_peaks` does. That is slower and predicts side lobes from the array: it shows
    weak reflectors beside strong ones of the same range, which are left out here.

    Main lobes are not parabolas, so the error of the parabolas is predicted from array and call, and subtracted. Each
    point has standard deviations of its position: see `ertis_numba.analysis.uncertainty.PositionUncertainty`.

    Parameters
    ----------
    settings : Settings
        Their processing names the directions; the air may be another with each image.
    grid : Grid, optional
        The directions themselves, as where the file that names them is not at hand.
    top : int
        At most so many points of an image, the strongest.
    min_level_db : float
        Below the strongest point of the image, at which to stop.

    Raises
    ------
    ArgumentError
        ``top`` is below 1, ``min_level_db`` is above 0, or the settings name no grid.
    """

    def __init__(
        self, settings: Settings, grid: Grid | None = None, *, top: int = 256, min_level_db: float = -20.0
    ) -> None:
        checks.instance("settings", settings, Settings, "an image or a recording holds")
        self._top = checks.integer("top", top, 1)
        self._smallest = 10 ** (checks.between("min_level_db", min_level_db, -1000.0, 0.0) / 20)
        grid = grid or direction_grid(settings.processing)
        self._directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
        self._neighbours = neighbours_of(self._directions)
        self._interpolator = PeakInterpolator(settings, self._directions, self._neighbours)
        self._spacing = spacing_of(self._directions, self._neighbours)
        self._uncertainty = PositionUncertainty(settings, is_planar=bool(np.ptp(self._directions[:, 2]) == 0))

    def __call__(self, image: Energyscape) -> PointCloud:
        """Return the points of an image.

        Raises
        ------
        ArgumentError
            The image has not the directions of this grid.
        """
        checks.instance("image", image, Energyscape, "Pipeline.process returns")
        amplitude = image.amplitude
        checks.shape("amplitude", amplitude.shape, (len(self._directions), len(image.range_m)))
        directions, ranges = self._maxima(amplitude, image.range_m)
        tops = self._interpolator(image, directions, ranges)
        position_m, levels = (
            (tops.direction * tops.range_m[:, None]).astype(np.float32),
            tops.amplitude.astype(np.float32),
        )
        order = np.argsort(-levels, kind="stable")
        resolution_rad = np.where(tops.is_between, 0.0, self._spacing[directions])
        uncertainty_m = self._uncertainty(image, position_m, levels, resolution_rad)
        return PointCloud(
            position_m[order], levels[order], image.settings, image.stamp, uncertainty_m=uncertainty_m[order]
        )

    def _maxima(
        self, amplitude: NDArray[np.float32], range_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return direction and range of each maximum.

        The first and the last range are none: what rises towards them lies outside of the image.
        """
        n_ranges = amplitude.shape[1]
        none = np.empty(0, dtype=np.int64)
        profile = amplitude.max(axis=0)
        if n_ranges < 3 or not profile.max() > 0:
            return none, none
        floor = np.maximum(side_lobe_floor(profile, range_m), profile.max() * np.float32(self._smallest))
        floor[[0, -1]] = np.inf
        # Two passes over all of the image, this and the profile, are what takes the time; few bins are left.
        above = amplitude >= floor
        if np.count_nonzero(above) > _BINS_OF_POINT * self._top:
            above = amplitude >= np.maximum(floor, self._raised(amplitude))
        places = np.flatnonzero(above)
        flat = amplitude.reshape(-1)
        here = flat[places]
        places = places[(here >= flat[places - 1]) & (here > flat[places + 1])]
        directions, ranges = np.divmod(places, n_ranges)
        here, around = flat[places, None], self._neighbours[directions]
        there = amplitude[around, ranges[:, None]]
        # Of two equal neighbours the first counts.
        beaten = (there > here) | ((there == here) & (around < directions[:, None]))
        points = np.flatnonzero(~beaten.any(axis=1))
        strongest = points[np.argsort(-here[points, 0], kind="stable")[: self._top]]
        return directions[strongest], ranges[strongest]

    def _raised(self, amplitude: NDArray[np.float32]) -> np.float32:
        """Return a level above which there are about as many bins of an image as need be looked at."""
        some = amplitude[:, ::_THINNED].ravel()
        count = min(len(some), max(1, _BINS_OF_POINT * self._top // _THINNED))
        return np.float32(np.partition(some, len(some) - count)[len(some) - count])
