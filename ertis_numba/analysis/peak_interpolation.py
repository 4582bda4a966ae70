"""Interpolation of the maxima of an image between its bins."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.point_spread import PointSpread
from ertis_numba.analysis.quadric_fits import MAX_RISE_DB, QuadricFits
from ertis_numba.frames import Energyscape
from ertis_numba.settings import Settings
from ertis_numba.stages.plan_response import deviation_of

__all__ = ["PeakInterpolator", "Tops", "listed"]

_MAX_CORRECTIONS = 8  # Number of corrections of the parabola error; coarse grids need more than fine ones.
_CONVERGED = 1e-5  # Change by a correction, in range bins, in unit vectors and in nepers.
_MAX_DIFFERENCE = 1.0  # Deviation in nepers from the samples of a single reflector; beyond it, there are several.
_MAX_SHIFT = 0.5  # Change by all corrections, in range bins and in nepers; beyond it, they have not converged.
_ABSENT = math.log(np.finfo(np.float32).tiny)  # Logarithm of an amplitude of 0, as of a bin that cleaning removes.
_DARK = 1e-6  # Amplitude below the side lobes of any array.
_EDGE_OF_LOBE = 0.5  # Amplitude relative to the maximum, below which a sample is not part of the main lobe.
_NOISE = 10 ** (0.5 / 20)  # Noise may raise a maximum above a main lobe through its strongest sample.
_NARROWER = 3.0  # The main lobe of adaptive beamformers in decibels, relative to that of delay-and-sum, is at most so.


class Tops(NamedTuple):
    """Interpolated maxima near given bins.

    Attributes
    ----------
    direction : (place, axis) float64
        Unit vectors.
    range_m, amplitude : (place,) float64
        Range in metres, and amplitude.
    width_rad : (place,) float64
        Spacing of the grid where the direction, or one of its angles, is that of the bin; 0 if it is interpolated. It
        is infinite at an edge of the grid beyond which the maximum may lie: see `QuadricFits.are_open`.
    """

    direction: NDArray[np.float64]
    range_m: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    width_rad: NDArray[np.float64]


def listed(amplitude: NDArray[np.float64], image: Energyscape) -> NDArray[np.float64]:
    """Return amplitudes that exceed the strongest bin of an image by less than 1 dB.

    Parameters
    ----------
    amplitude : (place,) float64
        Interpolated amplitudes, which are higher if the grid is coarser than half of the main lobe.
    image : Energyscape
    """
    return np.minimum(amplitude, float(image.amplitude.max(initial=0.0)) * 10 ** (MAX_RISE_DB / 20))


class PeakInterpolator:
    """Interpolator of maxima by parabolas through the logarithm of the amplitude, with a correction of their bias.

    A main lobe is not a parabola. The interpolator therefore predicts the samples of a reflector at the found position
    from array and call. It interpolates them as well, and subtracts the error of that interpolation. The correction
    applies to delay-and-sum of the fast method, and to maxima whose samples match a single reflector. Other maxima keep
    the result of the parabolas. At 60 dB above the noise, the correction reduces errors from about 4 mm to 0.1 mm.

    A maximum never leaves the cell of its direction, which ends half-way to each neighbour. It exceeds its bin by at
    most the loss of the main lobe over this distance. Lists of maxima also limit it by `listed`.

    Parameters
    ----------
    settings : Settings
    directions : (direction, axis) float64
        Unit vectors.
    neighbours : (direction, neighbour) int64
        Result of `ertis_numba.analysis.detect.neighbours_of`.
    only : (place,) int64, optional
        Directions whose maxima are needed; all by default, which takes longer to prepare.
    """

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
        self._spread = PointSpread(settings)
        self._is_predicted = settings.processing.method == "fast"
        self._deviation = deviation_of(settings, directions)

    def __call__(self, image: Energyscape, directions: NDArray[np.int64], ranges: NDArray[np.int64]) -> Tops:
        """Return the interpolated maxima near given bins of an image.

        Parameters
        ----------
        image : Energyscape
        directions, ranges : (place,) int64
            Indices of the bins. Maxima at the first and the last range are not interpolated along the range.
        """
        step_m = float(image.range_m[1] - image.range_m[0]) if len(image.range_m) > 1 else 0.0
        rows, columns = _bins(directions, self._neighbours[directions], ranges, last=len(image.range_m) - 1)
        measured = np.log(np.maximum(image.amplitude[rows, columns].astype(np.float64), np.finfo(np.float32).tiny))
        found = self._tops(directions, measured)
        if self._is_predicted and not image.settings.processing.is_adaptive:
            found = self._corrected(found, directions, measured, (rows, columns), step_m, image)
        shift_m, offset = found[:, 0].clip(-0.5, 0.5) * step_m, found[:, 1:4]
        offset, width_rad = self._fits.within_cells(self._row[directions], offset)
        rises = _filled(measured)[:, 3:] - measured[:, 1:2]
        is_open = self._fits.are_open(self._row[directions], rows[:, 3:], rises)
        top = self._directions[directions] + offset
        top /= np.linalg.norm(top, axis=1)[:, None]
        return Tops(
            direction=top,
            range_m=image.range_m[ranges] + shift_m,
            amplitude=np.minimum(np.exp(found[:, 4]), self._highest(image, directions, measured[:, 1], top, shift_m)),
            width_rad=np.where(is_open, np.inf, width_rad),
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

    def _corrected(
        self,
        found: NDArray[np.float64],
        directions: NDArray[np.int64],
        measured: NDArray[np.float64],
        bins: tuple[NDArray[np.int64], NDArray[np.int64]],
        step_m: float,
        image: Energyscape,
    ) -> NDArray[np.float64]:
        """Return the result of `_tops`, corrected where the samples match a single reflector."""
        rows, columns = bins
        offsets = self._directions[rows] - self._directions[directions][:, None]
        steps_m = step_m * (columns - columns[:, 1:2]).astype(np.float64)
        first, found, active = found, found.copy(), np.arange(len(found))
        last = np.full(len(found), np.inf)
        for _ in range(_MAX_CORRECTIONS):
            here = found[active]
            predicted = self._predicted(here, rows[active], offsets[active], steps_m[active], step_m, image)
            difference = measured[active] - predicted
            is_alike = np.abs(difference - difference[:, 1:2]).max(axis=1) < _MAX_DIFFERENCE
            correction = first[active] - self._tops(directions[active], predicted)
            size = np.abs(correction).max(axis=1)
            is_smaller = size < last[active]  # The corrections of noise need not converge.
            corrected = np.where(is_smaller[:, None], here + correction, here)
            found[active] = np.where(is_alike[:, None], corrected, first[active])
            last[active] = size
            active = active[is_alike & is_smaller & (size > _CONVERGED)]
            if not len(active):
                break
        change = np.abs(found - first)
        is_small = (change[:, 0] <= _MAX_SHIFT) & (change[:, 4] <= _MAX_SHIFT)
        return np.where(is_small[:, None], found, first)

    def _tops(self, directions: NDArray[np.int64], logs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the maxima of parabolas: (place, 5) float64.

        The columns are the shift along the range in bins, the three components of the direction offset, and the
        logarithm of the amplitude. Bins without amplitude, such as those that cleaning removes, count as
        half of the maximum. Results therefore change by about half a bin and 1 dB at most.
        """
        logs = _filled(logs)
        before, level, after = logs[:, 0], logs[:, 1], logs[:, 2]
        curvature = before - 2 * level + after
        shift = np.divide(0.5 * (before - after), curvature, out=np.zeros_like(curvature), where=curvature < 0)
        offset, rise = self._fits.tops(self._row[directions], logs[:, 3:] - level[:, None])
        return np.column_stack([shift, offset, level + 0.25 * (after - before) * shift + rise])

    def _predicted(
        self,
        found: NDArray[np.float64],
        rows: NDArray[np.int64],
        offsets: NDArray[np.float64],
        steps_m: NDArray[np.float64],
        step_m: float,
        image: Energyscape,
    ) -> NDArray[np.float64]:
        """Return predicted log amplitudes of reflectors at the found positions: (place, sample) float64."""
        middles = self._directions[rows[:, 0]]
        tops = middles + found[:, 1:4]
        tops = tops / np.linalg.norm(tops, axis=1)[:, None]
        away = offsets + (middles - tops)[:, None]
        away_m = steps_m - step_m * found[:, :1]
        deviation = None if self._deviation is None else self._deviation.of(rows.ravel())
        amplitude = self._spread(away.reshape(-1, 3), away_m.ravel(), image.settings.air, deviation=deviation)
        return np.asarray(np.log(np.maximum(amplitude.reshape(away_m.shape), _DARK)) + found[:, 4:])


def _filled(logs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return logarithms of samples, (place, sample), with half of the maximum in bins without amplitude."""
    return np.where(logs > _ABSENT, logs, logs[:, 1:2] - math.log(2))


def _bins(
    directions: NDArray[np.int64], around: NDArray[np.int64], ranges: NDArray[np.int64], *, last: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the direction and range indices of the samples of each maximum, both (place, sample) int64.

    The first three samples lie along the range, the others at the neighbouring directions.
    """
    columns = np.repeat(ranges[:, None], 3 + around.shape[1], axis=1)
    inner = (ranges > 0) & (ranges < last)
    columns[:, 0] -= inner
    columns[:, 2] += inner
    return np.concatenate([np.repeat(directions[:, None], 3, axis=1), around], axis=1), columns
