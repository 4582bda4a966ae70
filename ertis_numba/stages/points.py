"""From energyscapes to point clouds, fast enough to do so with every image."""

import math
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.air import sound_speed_m_s
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.geometry import Grid, direction_grid, microphones, unit_vectors
from ertis_numba.settings import Settings
from ertis_numba.stages.detect import ONE_SIDED, PULSE_M, SIDE_LOBE_DB, neighbours_of
from ertis_numba.waveform import matched_spectrum

__all__ = ["PointExtractor"]

_BINS_OF_POINT = 64
"""Of noise alone, so many bins are looked at for each point that is wanted, and not a third of the image."""
_THINNED = 16  # ranges of which one is looked at to tell how strong those are
_WAVES = 64  # of the call's band, which its widths are told from
_SAMPLE = 16_384  # bins that tell the noise, to a hundredth
_LINE = 0.2  # of the widths of a direction's neighbours, below which they lie in a line
_FLAT = 1e-12  # of the variance of an array, below which it has none


class PointExtractor:
    """Finds the local maxima of images, with tables that are made here, once for a grid.

    A point is a local maximum over directions and ranges that is above what the side lobes of the strongest
    reflector of about the same range can be. Position and energy are interpolated by parabolas through the logarithm
    of the energy, as `ertis_numba.find_peaks` does. That is slower and predicts side lobes from the array: it shows
    weak reflectors beside strong ones of the same range, which are left out here.

    Each point has the standard deviations that noise alone gives to its position, along range and across: the
    Cramér-Rao bounds of a single echo in white noise

    ``σ_range = c / (4π β √(2ρ))`` and ``σ_across = r / (k √(λ 2ρ))``,

    ρ being the power of the point over the mean power of the noise; β the root-mean-square width of the call's spectrum
    about its centre (P. M. Woodward, Probability and Information Theory, 1953, for the range ``cτ / 2``); k the
    root mean square of its wave numbers; and λ the variance of the microphones' positions along the direction, across
    the line of sight, in which it is least (H. L. Van Trees, Optimum Array Processing, 2002, section 8.4). An image
    of one elevation has the azimuth to go across only. The noise is estimated from the median of the image, which of a
    Rayleigh variable is √ln 2 of the root mean square; where echoes fill an image it counts them as noise. Infinite
    is what the array cannot tell. NaN is where the noise is not known: in images of other beamformers than
    delay-and-sum, whose noise is no Rayleigh variable, and where half of the image or more is 0, as `clean` leaves it.
    Errors of layout, temperature and near-field curvature come on top, and so does what echoes at the same place do to
    each other.

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
        self._top = checks.whole("top", top, 1)
        self._least = 10 ** (checks.between("min_level_db", min_level_db, -1000.0, 0.0) / 20)
        grid = grid or direction_grid(settings.processing)
        self._directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
        self._neighbours = neighbours_of(self._directions)
        self._fits = _Fits.of(self._directions, self._neighbours)
        self._spread = _Spread.of(settings, is_planar=bool(np.ptp(self._directions[:, 2]) == 0))

    def __call__(self, image: Energyscape) -> PointCloud:
        """Return the points of an image.

        Raises
        ------
        ArgumentError
            The image has not the directions of this grid.
        """
        energy = image.energy
        checks.shape("energy", energy.shape, (len(self._directions), len(image.range_m)))
        directions, ranges = self._maxima(energy, image.range_m)
        position_m, levels = self._interpolated(image, directions, ranges)
        order = np.argsort(-levels, kind="stable")
        uncertainty_m = self._spread(image, position_m, levels)
        return PointCloud(
            position_m[order], levels[order], image.settings, image.stamp, uncertainty_m=uncertainty_m[order]
        )

    def _maxima(
        self, energy: NDArray[np.float32], range_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return direction and range of each maximum.

        The first and the last range are none: what rises towards them lies outside of the image.
        """
        n_ranges = energy.shape[1]
        none = np.empty(0, dtype=np.int64)
        profile = energy.max(axis=0)
        if n_ranges < 3 or not profile.max() > 0:
            return none, none
        reach = max(1, round(PULSE_M / float(range_m[1] - range_m[0])))
        highest = scipy.ndimage.maximum_filter1d(profile, 2 * reach + 1, mode="nearest")
        floor = np.maximum(highest * np.float32(10 ** (-SIDE_LOBE_DB / 20)), profile.max() * np.float32(self._least))
        floor[[0, -1]] = np.inf
        # Two passes over all of the image, this and the profile, are what takes the time; few bins are left.
        above = energy >= floor
        if np.count_nonzero(above) > _BINS_OF_POINT * self._top:
            above = energy >= np.maximum(floor, self._raised(energy))
        places = np.flatnonzero(above)
        flat = energy.reshape(-1)
        here = flat[places]
        places = places[(here >= flat[places - 1]) & (here > flat[places + 1])]
        directions, ranges = np.divmod(places, n_ranges)
        here, around = flat[places, None], self._neighbours[directions]
        there = energy[around, ranges[:, None]]
        # Of two equal neighbours the first counts.
        beaten = (there > here) | ((there == here) & (around < directions[:, None]))
        points = np.flatnonzero(~beaten.any(axis=1))
        strongest = points[np.argsort(-here[points, 0], kind="stable")[: self._top]]
        return directions[strongest], ranges[strongest]

    def _raised(self, energy: NDArray[np.float32]) -> np.float32:
        """Return a level above which there are about as many bins of an image as need be looked at."""
        some = energy[:, ::_THINNED].ravel()
        count = min(len(some), max(1, _BINS_OF_POINT * self._top // _THINNED))
        return np.float32(np.partition(some, len(some) - count)[len(some) - count])

    def _interpolated(
        self, image: Energyscape, directions: NDArray[np.int64], ranges: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return position and amplitude of the maximum near each of some bins."""
        tiny = np.finfo(np.float32).tiny

        def logs(at: NDArray[np.int64], ranges: NDArray[np.int64]) -> NDArray[np.float64]:
            return np.log(np.maximum(image.energy[at, ranges].astype(np.float64), tiny))

        before, level, after = (logs(directions, ranges + step) for step in (-1, 0, 1))
        bend = before - 2 * level + after
        shift = np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend < 0)
        step_m = float(image.range_m[1] - image.range_m[0]) if len(image.range_m) > 1 else 0.0
        range_m = image.range_m[ranges] + shift * step_m
        rises = logs(self._neighbours[directions], ranges[:, None]) - level[:, None]
        offset, rise = self._fits.tops(directions, rises)
        top = self._directions[directions] + offset
        position_m = top * (range_m / np.linalg.norm(top, axis=1))[:, None]
        amplitude = np.exp(level + 0.25 * (after - before) * shift + rise)
        return position_m.astype(np.float32), amplitude.astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Fits:
    """How to fit a quadric to each direction and its neighbours, over the plane or the line in which they lie.

    Attributes
    ----------
    axes : (direction, 2, axis) float64
        Of the plane.
    inverse : (direction, 5, neighbour) float64
        From values to the coefficients of x, y, x², xy and y².
    is_plane : (direction,) bool
        Else a line, and y is nothing.
    reach : (direction,) float64
        Of the neighbours; 0 where no quadric can be fitted, and at the edge of the grid, whose neighbours lie to one
        side.
    """

    axes: NDArray[np.float64]
    inverse: NDArray[np.float64]
    is_plane: NDArray[np.bool_]
    reach: NDArray[np.float64]

    @classmethod
    def of(cls, directions: NDArray[np.float64], neighbours: NDArray[np.int64]) -> "_Fits":
        """Return those of a grid."""
        n_directions, n_samples = neighbours.shape
        if n_samples < 3:
            return cls(
                np.zeros((n_directions, 2, 3)),
                np.zeros((n_directions, 5, n_samples)),
                np.zeros(n_directions, dtype=np.bool_),
                np.zeros(n_directions),
            )
        offsets = directions[neighbours] - directions[:, None]
        reach = np.linalg.norm(offsets, axis=2).max(axis=1)
        one_sided = np.linalg.norm(offsets.mean(axis=1), axis=1) > ONE_SIDED * reach
        _, sizes, axes = np.linalg.svd(offsets, full_matrices=False)
        axes = axes[:, :2]
        is_plane = sizes[:, 1] > _LINE * sizes[:, 0]
        x, y = np.moveaxis(offsets @ axes.transpose(0, 2, 1), 2, 0)
        y = np.where(is_plane[:, None], y, 0.0)
        inverse = np.linalg.pinv(np.stack([x, y, x * x, x * y, y * y], axis=2))
        usable = n_samples > np.where(is_plane, 5, 2)
        return cls(axes, inverse, is_plane, np.where(usable & ~one_sided, reach, 0.0))

    def tops(
        self, directions: NDArray[np.int64], rises: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where quadrics are highest, from their directions: (place, axis) float64; and by how much they rise.

        No further than the samples, and the direction itself where there is no maximum.

        Parameters
        ----------
        directions : (place,) int64
        rises : (place, neighbour) float64
            From the value at the direction to those at its neighbours.
        """
        slope_x, slope_y, xx, xy, yy = np.einsum("pcn,pn->cp", self.inverse[directions], rises)
        xx, yy = 2 * xx, np.where(self.is_plane[directions], 2 * yy, -1.0)
        determinant = xx * yy - xy * xy
        is_top = (xx < 0) & (determinant > 0)
        scale = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=is_top)
        x, y = (xy * slope_y - yy * slope_x) * scale, (xy * slope_x - xx * slope_y) * scale
        is_near = np.hypot(x, y) <= self.reach[directions]
        x, y = np.where(is_near, x, 0.0), np.where(is_near, y, 0.0)
        offset = x[:, None] * self.axes[directions, 0] + y[:, None] * self.axes[directions, 1]
        return offset, 0.5 * (slope_x * x + slope_y * y)


@dataclass(frozen=True, slots=True, eq=False)
class _Spread:
    """What noise does to positions: see `PointExtractor`.

    Attributes
    ----------
    width_hz : float
        Of the call's spectrum, root mean square about its centre.
    frequency_hz : float
        Root mean square.
    covariance_m2 : (axis, axis) float64
        Of the microphones' positions.
    is_planar : bool
        Whether all directions have one elevation.
    """

    width_hz: float
    frequency_hz: float
    covariance_m2: NDArray[np.float64]
    is_planar: bool

    @classmethod
    def of(cls, settings: Settings, *, is_planar: bool) -> "_Spread":
        """Return that of an array and its call."""
        frequency_hz, power = matched_spectrum(settings, n_waves=_WAVES)
        mean_square = float(power @ frequency_hz**2)
        positions_m = microphones(settings.array).enabled_positions_m
        return cls(
            width_hz=math.sqrt(mean_square - float(power @ frequency_hz) ** 2),
            frequency_hz=math.sqrt(mean_square),
            covariance_m2=positions_m.T @ positions_m / len(positions_m),
            is_planar=is_planar,
        )

    def __call__(
        self, image: Energyscape, position_m: NDArray[np.float32], levels: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return standard deviations along range and across: (point, 2) float32, in metres; NaN if they are unknown."""
        noise = _noise(image) if len(levels) else 0.0
        if not noise:
            return np.full((len(levels), 2), np.nan, dtype=np.float32)
        relative = noise / (math.sqrt(2) * levels.astype(np.float64))
        speed_m_s = sound_speed_m_s(image.settings.air)
        along_m = speed_m_s / (4 * math.pi * self.width_hz) * relative
        reach_m = np.sqrt(self._least_variance_m2(position_m.astype(np.float64)))
        wave_1_m = 2 * math.pi * self.frequency_hz / speed_m_s
        range_m = np.linalg.norm(position_m, axis=1)
        across_m = np.full(len(levels), np.inf)
        np.divide(range_m * relative / wave_1_m, reach_m, out=across_m, where=reach_m > 0)
        return np.stack([along_m, across_m], axis=1).astype(np.float32)

    def _least_variance_m2(self, position_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the least variance of the array across the lines of sight: (point,) float64."""
        azimuth_rad = np.arctan2(position_m[:, 1], position_m[:, 0])
        level_m = np.hypot(position_m[:, 0], position_m[:, 1])
        elevation_rad = np.arctan2(position_m[:, 2], level_m)
        sideways = unit_vectors(azimuth_rad + math.pi / 2, np.zeros_like(azimuth_rad))
        aa: NDArray[np.float64] = np.einsum("pi,ij,pj->p", sideways, self.covariance_m2, sideways)
        if self.is_planar:
            return np.maximum(aa, 0.0)
        upwards = unit_vectors(azimuth_rad, elevation_rad + math.pi / 2)
        ab = np.einsum("pi,ij,pj->p", sideways, self.covariance_m2, upwards)
        bb = np.einsum("pi,ij,pj->p", upwards, self.covariance_m2, upwards)
        least = (aa + bb) / 2 - np.hypot((aa - bb) / 2, ab)
        # What is left of rounding is no aperture.
        return np.asarray(np.where(least > _FLAT * (aa + bb), least, 0.0))


def _noise(image: Energyscape) -> float:
    """Return the root mean square of the noise of an image; 0 if it is not known."""
    if image.settings.processing.beamformer != "delay_and_sum":
        return 0.0
    some = image.energy[:, ::_THINNED]
    some = some[:: max(1, some.size // _SAMPLE)]
    return float(np.median(some)) / math.sqrt(math.log(2))
