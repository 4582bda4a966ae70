"""Interpolation of the maxima of an image between its bins."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.analysis.echo_fits import EchoFits
from ertis_numba.analysis.plan_errors import plan_error
from ertis_numba.analysis.point_spread import spread_of
from ertis_numba.analysis.quadric_fits import MAX_RISE_DB, QuadricFits
from ertis_numba.frames import Energyscape
from ertis_numba.frames.level_codes import rounding_np
from ertis_numba.geometry import unit_vectors
from ertis_numba.settings import Settings

__all__ = ["PeakInterpolator", "Tops", "centred", "listed"]

_MODEL = 2e-4  # Least error of a predicted sample, relative to the amplitude.
_EDGE_OF_LOBE = 0.5  # Amplitude relative to the maximum, below which a sample is not part of the main lobe.
_NOISE = 10 ** (0.5 / 20)  # Noise may raise a maximum above a main lobe through its strongest sample.
_MAX_AREA = 1000  # Bins of an area of equal levels that are examined.
_NARROWER = 3.0  # The main lobe of adaptive beamformers in decibels, relative to that of delay-and-sum, is at most so.


class Tops(NamedTuple):
    """Interpolated maxima (place,) near given bins, with unit vectors ``direction`` (place, axis).

    ``width_rad`` is the spacing of the grid where the direction, or one of its angles, is that of the bin; 0 if it is
    interpolated, infinite at an edge of the grid beyond which the maximum may lie: see `QuadricFits.are_open`. Standard
    deviations of fitted echoes are those of `Fitted`, as is ``misfit``; NaN for other maxima.
    """

    direction: NDArray[np.float64]
    range_m: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    width_rad: NDArray[np.float64]
    range_sd_m: NDArray[np.float64]
    across_sd_rad: NDArray[np.float64]
    level_sd: NDArray[np.float64]
    misfit: NDArray[np.float64]


def listed(amplitude: NDArray[np.float64], image: Energyscape) -> NDArray[np.float64]:
    """Return amplitudes that exceed the strongest bin by less than 1 dB, unlike interpolated ones of a coarse grid."""
    return np.minimum(amplitude, float(image.amplitude.max(initial=0.0)) * 10 ** (MAX_RISE_DB / 20))


def centred(
    image: Energyscape, neighbours: NDArray[np.int64], directions: NDArray[np.int64], ranges: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the places of maxima; of rounded levels, the middles of areas of one level that no neighbour exceeds."""
    if not image.level_step_db:
        return directions, ranges
    looks, flat, n_ranges = (
        unit_vectors(image.azimuth_rad, image.elevation_rad),
        image.amplitude.reshape(-1),
        len(image.range_m),
    )
    found: dict[int, None] = {}
    for place in directions * n_ranges + ranges:
        same = new = around = np.array([place])
        while len(new) and len(same) < _MAX_AREA and flat[around].max() <= flat[place]:
            row, column = np.divmod(new, n_ranges)
            beside = neighbours[row] * n_ranges + column[:, None]
            around = np.unique(np.concatenate([beside.ravel(), new[column > 0] - 1, new[column < n_ranges - 1] + 1]))
            new = np.setdiff1d(around[flat[around] == flat[place]], same)
            same = np.concatenate([same, new])
        if flat[around].max() <= flat[place]:
            row, column = np.divmod(same, n_ranges)
            within = np.abs(column - column.mean()) <= 0.5
            nearness = looks[row] @ looks[row].sum(axis=0)
            found[int(same[np.argmax(np.where(within | (not within.any()), nearness, -np.inf))])] = None
    kept = np.array([*found], dtype=np.int64)
    return kept // n_ranges, kept % n_ranges


class PeakInterpolator:
    """Interpolator of maxima between the bins of an image, prepared for all directions or for ``only`` some."""

    # Parabolas through logarithms locate a maximum, or `EchoFits` for delay-and-sum of the fast method. A maximum never
    # leaves the cell of its direction, which ends half-way to each neighbour.

    def __init__(
        self,
        settings: Settings,
        directions: NDArray[np.float64],
        neighbours: NDArray[np.int64],
        *,
        only: NDArray[np.int64] | None = None,
    ) -> None:
        self._directions, self._neighbours = directions, neighbours
        wanted = np.arange(len(directions)) if only is None else np.unique(only)
        self._row = np.zeros(len(directions), dtype=np.int64)
        self._row[wanted] = np.arange(len(wanted))
        self._fits = QuadricFits.of(directions, neighbours, wanted)
        self._spread = spread_of(settings)
        is_predicted = settings.processing.method == "fast" and not settings.processing.is_adaptive
        self._echoes = EchoFits(settings, directions, neighbours, wanted) if is_predicted else None
        self._model = math.hypot(_MODEL, plan_error(settings)) if is_predicted else 0.0

    def __call__(
        self, image: Energyscape, directions: NDArray[np.int64], ranges: NDArray[np.int64], *, noise: float
    ) -> Tops:
        """Return maxima near given bins, at the first and the last range not along it; ``noise`` is 0 if unknown."""
        step_m = float(image.range_m[1] - image.range_m[0]) if len(image.range_m) > 1 else 0.0
        rows, columns = _bins(directions, self._neighbours[directions], ranges, last=len(image.range_m) - 1)
        measured = np.log(np.maximum(image.amplitude[rows, columns].astype(np.float64), np.finfo(np.float32).tiny))
        found = np.empty((len(measured), 5))
        kernels.load_points().interpolate_tops(self._fits.quadrics, self._row[directions], measured, found)
        shift_m, offset, level, sd = found[:, 0] * step_m, found[:, 1:4], found[:, 4], np.full((3, len(found)), np.nan)
        row, is_sparse, misfit = self._row[directions], np.zeros(len(found), np.bool_), np.zeros(len(found))
        is_fitted = self._echoes is not None
        if self._echoes is not None:
            # A rounded level changes the magnitude alone, but half of the power of an error of the model.
            model = math.hypot(self._model, math.sqrt(2) * rounding_np(image.level_step_db))
            shift_m, offset, level, *sds, is_sparse, misfit = self._echoes(
                image, row, rows, columns, found, noise=noise, model=model
            )
            sd = np.array(sds)
        within_m = shift_m.clip(-0.5 * step_m, 0.5 * step_m)
        sd[0], shift_m = np.hypot(sd[0], shift_m - within_m), within_m
        beyond_rad = np.zeros(len(found))
        if is_fitted:
            offset, beyond_rad = self._fits.within_limits(row, rows[:, 3:], offset)
        offset, width_rad = self._fits.within_cells(row, offset, is_fitted=is_fitted)
        is_open = self._fits.are_open(row, rows[:, 3:], _filled(measured)[:, 3:] - measured[:, 1:2])
        is_open |= beyond_rad > 0.5 * self._fits.width_rad[row]
        width_rad = np.hypot(width_rad, math.sqrt(12) * beyond_rad)
        width_rad = np.where(is_sparse, self._fits.width_rad[row], width_rad)
        top = self._directions[directions] + offset
        top /= np.linalg.norm(top, axis=1)[:, None]
        highest = self._highest(image, directions, measured[:, 1], top, shift_m)
        amplitude = np.minimum(np.exp(level), highest)
        return Tops(
            direction=top,
            range_m=image.range_m[ranges] + shift_m,
            amplitude=amplitude,
            width_rad=np.where(is_open, np.inf, width_rad),
            range_sd_m=sd[0],
            across_sd_rad=sd[1],
            level_sd=np.hypot(sd[2], level - np.log(amplitude)),
            misfit=misfit,
        )

    def _highest(
        self,
        image: Energyscape,
        directions: NDArray[np.int64],
        measured: NDArray[np.float64],
        tops: NDArray[np.float64],
        shift_m: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the largest possible amplitudes of reflectors at interpolated positions, from those of their bins."""
        loss = self._spread(self._directions[directions] - tops, shift_m, image.settings.air).clip(_EDGE_OF_LOBE, 1.0)
        lobe = loss**_NARROWER if image.settings.processing.is_adaptive else loss
        return np.asarray(np.exp(measured) * _NOISE / lobe)


def _filled(logs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return logarithms of samples, (place, sample), with half of the maximum in bins without amplitude."""
    return np.where(logs > kernels.ABSENT, logs, logs[:, 1:2] - math.log(2))


def _bins(
    directions: NDArray[np.int64], around: NDArray[np.int64], ranges: NDArray[np.int64], *, last: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return directions and ranges of samples, (place, sample): three along the range, then the neighbours."""
    columns = np.repeat(ranges[:, None], 3 + around.shape[1], axis=1)
    inner = (ranges > 0) & (ranges < last)
    columns[:, 0] -= inner
    columns[:, 2] += inner
    return np.concatenate([np.repeat(directions[:, None], 3, axis=1), around], axis=1), columns
