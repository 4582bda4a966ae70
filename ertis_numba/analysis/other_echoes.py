"""Amplitudes of other echoes at the places of points, which disturb these."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.peak_interpolation import Tops
from ertis_numba.analysis.point_spread import PointSpread
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import unit_vectors

__all__ = ["listed_echoes", "unlisted_echoes"]

_LOBE: Final = 10 ** (3.0 / 20) - 1  # Error of a predicted side lobe relative to it, as of `SideLobes`.
_SLOPE: Final = 0.05  # The same of the pulse along the range.
_NOISE: Final = 3.0  # Amplitude relative to the noise, below which nothing is seen.
_PLAN: Final = 0.5  # Error of the slopes relative to the error budget.
_PHASE: Final = 1.5  # Amplitude of an echo relative to the change that it causes.
_BESIDE: Final = 1.5  # First offset along the range in steps; the fit of a point includes nearer ones.
_SMEARED: Final = 2.0  # Images of other points along the range relative to their pulse.

Floats = NDArray[np.float64]


def listed_echoes(spread: PointSpread, image: Energyscape, tops: Tops, noise: float) -> Floats:
    """Return the amplitude of other points' images at each point, relative to its own: (point,) float64.

    Side lobes of stronger points are no other echoes. They have the amplitude that is predicted for them.
    """
    leak = _leak(spread, image, tops)
    echoes = np.zeros(len(leak))
    for point in np.argsort(-tops.amplitude, kind="stable"):
        lobes, amplitude = leak[point] * echoes, float(tops.amplitude[point])
        strongest = lobes.max()
        doubt = _LOBE * strongest + math.sqrt(max(float(lobes @ lobes) - strongest**2, 0.0)) + noise
        low, high = max(strongest - doubt, 0.0), strongest + doubt
        own = max(amplitude**2 - high**2, low**2 - amplitude**2, 0.0)
        echoes[point] = math.sqrt(own) if strongest > 0 else amplitude
    return np.asarray(np.linalg.norm(leak * echoes, axis=1) / tops.amplitude)


def unlisted_echoes(spread: PointSpread, image: Energyscape, tops: Tops, noise: float) -> Floats:
    """Return the amplitude of echoes within the slopes of points, relative to these: (point,) float64.

    They are no maxima, but change the pulse along the range.
    """
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    found, reach_m = np.zeros(len(tops.range_m)), spread.skirt_m
    if len(image.range_m) < 2:
        return found
    step_m, scale = float(image.range_m[1] - image.range_m[0]), spread.scale(image.settings.air)
    plan = _PLAN * 10 ** (image.settings.accuracy.max_error_db / 20)
    tilt_s, _ = spread.tilts(tops.range_m, image.settings.air)
    across = _leak(spread, image, tops, is_across=True) * tops.amplitude
    for point, range_m in enumerate(tops.range_m):
        first, last = np.searchsorted(image.range_m, [range_m - reach_m, range_m + reach_m])
        if first == last:  # The ranges are farther apart than a pulse is long.
            continue
        nearest = int(np.argmax(directions @ tops.direction[point]))
        row = image.amplitude[nearest, first:last].astype(np.float64)
        offset_m = image.range_m[first:last] - range_m
        pulse, middle = spread.along(scale * offset_m, tilt_s[point]), int(np.abs(offset_m).argmin())
        aside = np.tile(directions[nearest] - tops.direction[point], (len(row), 1))
        untilted = np.maximum(spread.along(scale * offset_m, 0.0), pulse / 2)  # Zeros of a pulse are no reference.
        image_there = spread(aside, offset_m, image.settings.air) * pulse / untilted
        own = row[middle] / max(image_there[middle], _SLOPE) * image_there
        near = np.flatnonzero(across[point])
        away_m = offset_m - (tops.range_m[near] - range_m)[:, None]
        others = across[point, near] @ spread.along(scale * away_m, 0.0)
        doubt = _SLOPE * own + _SMEARED * others + _NOISE * noise + plan * own[middle]
        rest = np.where(np.abs(offset_m) > _BESIDE * step_m, (row - own) ** 2 - doubt**2, 0.0)
        found[point] = _PHASE * math.sqrt(max(float((rest * pulse**2).max()), 0.0)) / tops.amplitude[point]
    return found


def _leak(spread: PointSpread, image: Energyscape, tops: Tops, *, is_across: bool = False) -> Floats:
    """Return the amplitude of each point's image at each other, or at its direction and their own range."""
    is_near = np.abs(tops.range_m - tops.range_m[:, None]) < spread.valid_m
    np.fill_diagonal(is_near, val=False)
    here, there = np.nonzero(is_near)
    offset, offset_m = tops.direction[here] - tops.direction[there], tops.range_m[here] - tops.range_m[there]
    leak = np.zeros(is_near.shape)
    leak[here, there] = spread(offset, np.zeros(len(here)) if is_across else offset_m, image.settings.air)
    return leak
