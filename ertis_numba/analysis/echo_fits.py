"""Fits of single echoes to the samples of an image around its maxima."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.analysis.point_spread import spread_of
from ertis_numba.chain.plan_response import deviation_of
from ertis_numba.frames import Energyscape
from ertis_numba.settings import Settings

__all__ = ["EchoFits", "Fitted"]

_COARSE = 0.8  # Amplitude of an echo at the border of a cell, below which other places may explain the samples.
_SPARSE = 0.5  # The same, below which the errors of range and level are those of a wide cell, too.
_SPARSE_NP = 0.35
_STARTS = (0.25, 0.5)  # Shares of the way to each neighbour.
_UNIFORM = 0.34  # A uniform distribution has 68 % of its values within this share of its width around the middle.
_UNKNOWN = 1.0  # Variance of what a fit does not determine, in square metres, radians or nepers.
_OTHER = 0.05  # Error of the model beyond the noise, above which samples are not those of a single echo at rest.
_CHANCE = 0.6  # Error of the model relative to the noise, up to which noise alone may have caused the misfit.
_PLAN = 3.0  # The same relative to that of the plan.
_LEAST = 0.002  # The same of all plans.
_SAME = 1e-9  # Distance in radians below which two directions are one.

Floats = NDArray[np.float64]


class Fitted(NamedTuple):
    """Echoes that were fitted, with ranges relative to those of the maxima: (place,).

    ``offset`` (place, axis) is that of the direction, before it is scaled to a unit vector, and ``level`` the natural
    logarithm of the amplitude. Standard deviations are those of the range, of the direction along its least certain
    axis, and of the level in nepers. ``is_sparse`` is True where the main lobe of an echo is narrower than the cell, so
    that side lobes may decide its direction. ``misfit`` is the deviation of the samples from those of a single echo,
    relative to its amplitude, beyond noise and model.
    """

    range_m: Floats
    offset: Floats
    level: Floats
    range_sd_m: Floats
    across_sd_rad: Floats
    level_sd: Floats
    is_sparse: NDArray[np.bool_]
    misfit: Floats


class EchoFits:
    """Fits of single echoes to maxima of images of delay-and-sum in ``wanted`` directions, unit vectors (…, axis)."""

    def __init__(
        self, settings: Settings, directions: Floats, neighbours: NDArray[np.int64], wanted: NDArray[np.int64]
    ) -> None:
        self._directions = np.ascontiguousarray(directions)
        self._spread = spread_of(settings, path_m=sum(settings.processing.range_m))
        self._beams = self._spread.beams(self._directions, deviation_of(settings, directions))
        self._is_planar = bool(np.ptp(directions[:, 2]) == 0)
        offsets = directions[neighbours[wanted]] - directions[wanted][:, None]
        distance = np.linalg.norm(offsets, axis=2)
        self._is_other = distance > _SAME
        self._width_rad = np.where(self._is_other, distance, np.inf).min(axis=1, initial=np.inf)
        self._axes = self._axes_of(directions[wanted])
        self._at_border = self._least_at_border()
        self._aside = np.concatenate(
            [share * np.einsum("pni,pji->pnj", offsets, self._axes) for share in _STARTS], axis=1
        )

    def __call__(
        self,
        image: Energyscape,
        place: NDArray[np.int64],
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        tops: Floats,
        *,
        noise: float,
        model: float,
    ) -> Fitted:
        """Return the echoes that fit samples (place, sample) best."""
        # Samples are the maximum, those before and after it in range, and its neighbours. `tops` (place, 5) are the
        # shift in range steps, the offset of the direction, and the logarithm of the amplitude.
        amplitude = image.amplitude[rows, columns].astype(np.float64)
        is_used = amplitude > 0
        is_used[:, 3:] &= self._is_other[place]
        is_used[:, [0, 2]] &= columns[:, [0, 2]] != columns[:, 1:2]
        axes, width_rad, at_border = self._axes[place], self._width_rad[place], self._at_border[place]
        is_sparse = at_border < _SPARSE
        tilt_s, heard = self._spread.tilts(image.range_m[columns[:, 1]].astype(np.float64), image.settings.air)
        samples = kernels.EchoSamples(
            rows,
            is_used,
            amplitude,
            image.range_m[columns] - image.range_m[columns[:, 1:2]],
            image.range_m[columns[:, 1]].astype(np.float64),
            at_border < _COARSE,
            tilt_s,
        )
        step_m = float(image.range_m[1] - image.range_m[0]) if len(image.range_m) > 1 else 0.0
        starts = self._starts(tops, step_m, place, amplitude[:, 1])
        out = np.empty((len(rows), kernels.N_VALUES))
        kernels.load_points().fit_echoes(
            self._spread.pulse,
            self._beams,
            samples,
            starts,
            axes,
            noise,
            model,
            image.settings.processing.wavefront == "spherical",
            self._spread.scale(image.settings.air),
            out,
        )
        out[:, 3] += np.log(heard)
        covariance = out[:, 5:21].reshape(-1, 4, 4)
        covariance[~np.isfinite(covariance).all(axis=(1, 2))] = _UNKNOWN * np.eye(4)
        across = covariance[:, 1:3, 1:3]
        widest = across[:, 0, 0] if self._is_planar else np.linalg.norm(across, 2, axis=(1, 2))
        # Samples that are not those of a single echo keep the maximum of the parabolas; the difference is uncertain.
        chance = noise / np.maximum(amplitude[:, 1], np.finfo(np.float32).tiny)
        is_other = out[:, 21] > _OTHER + chance
        kept = np.where(is_other[:, None], starts[:, 0], out[:, :4])
        variance = np.stack([covariance[:, 0, 0], widest, covariance[:, 3, 3]])
        away = kept - out[:, :4]
        variance += np.stack([away[:, 0], np.hypot(away[:, 1], away[:, 2]), away[:, 3]]) ** 2
        sd = np.sqrt(np.minimum(variance, _UNKNOWN))
        extent_m = np.linalg.norm(self._spread.pulse.positions_m, axis=1).max()
        return Fitted(
            kept[:, 0],
            np.einsum("pi,pij->pj", kept[:, 1:3], axes),
            kept[:, 3],
            np.hypot(sd[0], np.where(is_sparse, _UNIFORM * np.minimum(width_rad, np.pi) * extent_m / 2, 0.0)),
            sd[1],
            np.hypot(sd[2], np.where(is_sparse, _SPARSE_NP, 0.0)),
            is_sparse,
            np.sqrt(np.maximum(out[:, 21] ** 2 - (_PLAN * model) ** 2 - (_CHANCE * chance) ** 2 - _LEAST**2, 0.0)),
        )

    def _axes_of(self, ahead: Floats) -> Floats:
        """Return unit vectors to the left and upwards, across directions: (place, 2, axis) float64."""
        level = np.hypot(ahead[:, 0], ahead[:, 1])
        is_up = level < _SAME
        left = np.stack([-ahead[:, 1], np.where(is_up, 1.0, ahead[:, 0]), np.zeros(len(ahead))], axis=1)
        left /= np.where(is_up, 1.0, level)[:, None]
        return np.stack([left, np.zeros_like(left) if self._is_planar else np.cross(ahead, left)], axis=1)

    def _least_at_border(self) -> Floats:
        """Return the least amplitude, in the direction of a cell, of echoes at its border: (place,) float64."""
        half_rad = np.where(np.isfinite(self._width_rad), self._width_rad, 0.0)[:, None] / 2
        none_m = np.zeros(len(half_rad))
        return np.minimum(*(self._spread(half_rad * self._axes[:, axis], none_m) for axis in (0, 1)))

    def _starts(self, tops: Floats, step_m: float, place: NDArray[np.int64], amplitude: Floats) -> Floats:
        """Return the starts of the fits: the interpolated maximum, and places towards the neighbours."""
        found = np.zeros((len(tops), 1 + self._aside.shape[1], 4))
        found[:, 0, 0] = step_m * tops[:, 0]
        found[:, 0, 1:3] = np.einsum("pi,pji->pj", tops[:, 1:4], self._axes[place])
        found[:, 0, 3] = tops[:, 4]
        found[:, 1:, 1:3] = self._aside[place]
        found[:, 1:, 3] = np.log(np.maximum(amplitude, np.finfo(np.float32).tiny))[:, None]
        return found
