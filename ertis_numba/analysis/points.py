"""Point clouds of images, computed fast enough for every image of a stream."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.detect import neighbours_of
from ertis_numba.analysis.directional_noise import pulse_steps, stands_out
from ertis_numba.analysis.noise import noise_of, threshold_of
from ertis_numba.analysis.outside_echo import has_outside, outside_of
from ertis_numba.analysis.peak_interpolation import PeakInterpolator, Tops, centred, listed
from ertis_numba.analysis.point_spread import spread_of
from ertis_numba.analysis.side_lobes import EdgeFloor, side_lobe_floor
from ertis_numba.analysis.uncertainty import PositionUncertainty
from ertis_numba.base import checks
from ertis_numba.base.constants import FALSE_ALARM
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.geometry import Grid, direction_grid, observable_angles, unit_vectors
from ertis_numba.settings import Settings

__all__ = ["MIN_LEVEL_DB", "TOP", "EchoPointExtractor", "PointExtractor"]

TOP: Final = 256
"""Default of the largest number of points per image."""
MIN_LEVEL_DB: Final = -20.0
"""Default of the lowest level of points, relative to the strongest of the image."""

_BINS_OF_POINT = 64
"""Maximum number of bins to examine per point; in noise, a third of the image would be candidates otherwise."""
_THINNED = 16  # One of so many ranges serves to estimate the distribution of amplitudes.


class PointExtractor:
    """Extractor of the local maxima of images as points, with tables computed once for a grid.

    A point is a local maximum over directions and ranges that exceeds the possible side lobes, raised by noise, of the
    strongest reflector at about the same range, and that noise from its direction does not explain: see
    `ertis_numba.analysis.directional_noise.stands_out`. Position and amplitude are interpolated as in
    `ertis_numba.find_peaks`. The latter is slower and predicts side lobes from the array. It finds weak reflectors
    beside strong ones at the same range, which this class discards.

    Each point has standard deviations of its position: see
    `ertis_numba.analysis.uncertainty.PositionUncertainty`. That across the range is infinite if the array does not
    observe azimuth and elevation, as with microphones on a line. Those in one place yield no points.

    Parameters
    ----------
    settings : Settings
        Settings of the images. The air may differ between images.
    grid : Grid, optional
        Directions of the images; by default, those of the settings. Pass a grid if the file of the directions is not
        available.
    top : int
        Maximum number of points per image; the strongest 256 by default.
    min_level_db : float
        Minimum level relative to the strongest point of the image; -20 dB by default.
    false_alarm : float or None
        Probability that noise alone yields a point of an image, approximately; 0.001 by default. None keeps the maxima
        of noise, too.

    Raises
    ------
    ArgumentError
        ``top`` is below 1, ``min_level_db`` is above 0, ``false_alarm`` is not between 1e-12 and 1, or the directions
        of the settings are not available.

    Examples
    --------
    Compute the point cloud of every measurement of a recording::

        with ertis.open_recording("data/synthetic/reflectors.h5") as recording:
            pipeline = ertis.Pipeline(recording.settings)
            extract = ertis.PointExtractor(pipeline.settings, pipeline.grid)
            clouds = [extract(pipeline.process(measurement)) for measurement in recording]
    """

    _noise_only = False

    def __init__(
        self,
        settings: Settings,
        grid: Grid | None = None,
        *,
        top: int = TOP,
        min_level_db: float = MIN_LEVEL_DB,
        false_alarm: float | None = FALSE_ALARM,
    ) -> None:
        checks.instance("settings", settings, Settings, "an image or a recording contains")
        seen = observable_angles(settings.array)
        self._has_directions, self._has_places = any(seen[:2]), self._noise_only or all(seen[:2])
        self._top = checks.integer("top", top, 1)
        self._smallest = 10 ** (checks.between("min_level_db", min_level_db, -1000.0, 0.0) / 20)
        if false_alarm is not None:
            checks.between("false_alarm", false_alarm, 1e-12, 1.0)
        self._false_alarm = None if self._noise_only else false_alarm
        grid = grid or direction_grid(settings.processing)
        self._directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
        self._neighbours = neighbours_of(self._directions)
        self._interpolator = PeakInterpolator(settings, self._directions, self._neighbours)
        spread = spread_of(settings)
        self._edges, self._reach_m = EdgeFloor(self._directions, spread), spread.reach_m
        self._uncertainty = PositionUncertainty(
            settings, is_planar=bool(np.ptp(self._directions[:, 2]) == 0), noise_only=self._noise_only
        )

    def __call__(self, image: Energyscape) -> PointCloud:
        """Return the points of an image.

        Raises
        ------
        ArgumentError
            The image does not have the directions of this grid.
        """
        checks.instance("image", image, Energyscape, "Pipeline.process returns")
        amplitude = image.amplitude
        checks.shape("amplitude", amplitude.shape, (len(self._directions), len(image.range_m)))
        directions, ranges = self._maxima(image)
        noise = noise_of(image) if len(directions) else 0.0
        tops = self._interpolator(image, directions, ranges, noise=noise)
        position_m, levels = (
            (tops.direction * tops.range_m[:, None]).astype(np.float32),
            listed(tops.amplitude, image).astype(np.float32),
        )
        order = np.argsort(-levels, kind="stable")
        width_rad = np.where(self._are_open(image, tops), math.pi, tops.width_rad)
        found = self._uncertainty(image, tops._replace(width_rad=width_rad), noise=noise)
        across_rad = found.across_rad if self._has_places else math.inf
        uncertainty_m = np.stack([found.range_m, np.abs(tops.range_m) * across_rad], axis=1).astype(np.float32)
        return PointCloud(
            position_m[order], levels[order], image.settings, image.stamp, uncertainty_m=uncertainty_m[order]
        )

    def _are_open(self, image: Energyscape, tops: Tops) -> NDArray[np.bool_]:
        """Return True for points that may be echoes from beyond the grid, or side lobes of such echoes: (point,)."""
        is_open = np.isinf(tops.width_rad)
        if not has_outside(image.settings, self._directions):
            return is_open
        for place in np.flatnonzero(~is_open):
            is_open[place] = outside_of(image, self._directions, float(tops.range_m[place])) is not None
        is_near = np.abs(tops.range_m - tops.range_m[:, None]) < self._reach_m
        is_stronger = tops.amplitude > tops.amplitude[:, None]
        return np.asarray(is_open | (is_near & is_stronger & is_open).any(axis=1))

    def _maxima(self, image: Energyscape) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the direction and range indices of all maxima."""
        amplitude, n_ranges = image.amplitude, len(image.range_m)
        none = np.empty(0, dtype=np.int64)
        profile = amplitude.max(axis=0)
        if not self._has_directions or n_ranges < 3 or not profile.max() > 0:
            return none, none
        lobes = side_lobe_floor(profile, image.range_m, threshold_of(image, self._false_alarm))
        floor = np.maximum(np.maximum(lobes, profile.max() * np.float32(self._smallest)), self._edges(image))
        floor[[0, -1]] = np.inf
        # This pass over the whole image and that of the profile dominate the time. Few bins remain.
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
        # The first of two equal neighbours counts.
        beaten = (there > here) | ((there == here) & (around < directions[:, None]))
        points = np.flatnonzero(~beaten.any(axis=1))
        strongest = points[np.argsort(-here[points, 0], kind="stable")[: self._top]]
        directions, ranges = directions[strongest], ranges[strongest]
        directions, ranges = centred(image, self._neighbours, directions, ranges)
        if self._false_alarm is None:
            return directions, ranges
        stays = stands_out(image, directions, ranges, self._false_alarm, pulse_steps(image))
        return directions[stays], ranges[stays]

    def _raised(self, amplitude: NDArray[np.float32]) -> np.float32:
        """Return an amplitude threshold that leaves about the intended number of bins to examine."""
        some = amplitude[:, ::_THINNED].ravel()
        count = min(len(some), max(1, _BINS_OF_POINT * self._top // _THINNED))
        return np.float32(np.partition(some, len(some) - count)[len(some) - count])


class EchoPointExtractor(PointExtractor):
    """Extractor for fusion and odometry, whose uncertainties are those of noise only."""

    # With the misfit to a single echo as well, both would accept echoes of other reflectors as those of one.

    _noise_only = True
