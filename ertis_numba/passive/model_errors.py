"""Errors of the model that each bin contains one wave of a source, as far as they may look like further sources."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.passive.detection_law import independent_samples
from ertis_numba.passive.heard_band import HeardBand
from ertis_numba.passive.likelihood import BandLikelihood

__all__ = ["beside_others", "beside_sources"]

Floats = NDArray[np.float64]

_HIDDEN: Final = 0.1  # Error relative to a standard deviation of the power of noise that causes no further alarms.
_MOMENTS: Final = (1.0, 0.75)  # of Gaussian frequencies x with variance 1: that of x, and that of x² / 2 with its mean
_LEFT: Final = 2 / 3  # Least share of the dimensions that is left for further sources.
_FLUCTUATION: Final = 40.0  # Four standard deviations of the power of noise, relative to hidden errors.
_LEAST: Final = 1e-30
_MARGIN: Final = 2.0  # Largest power of errors relative to that expected.


def beside_sources(
    likelihood: BandLikelihood, places: Floats, omegas: Floats, band: HeardBand, omega: Floats
) -> tuple[BandLikelihood, float]:
    """Return the likelihood of further sources, and the largest power of errors in a beam relative to that of noise.

    The frequencies of a source within a bin differ, or blocks of distant microphones hear different parts of its sound.
    Its waves then lie in the space of the wave and of its derivatives by frequency. Derivatives that stand out of the
    noise are left out like the wave, as long as two thirds of the dimensions remain. Those with more power than is
    expected are kept: it may be that of a further source close by.
    """
    orders = np.zeros(len(places), np.intp)
    if not len(places):
        return likelihood.beside(places, omegas, omega), 0.0
    powers = np.maximum(likelihood.separated(places, omegas)[0], 0)
    derivatives = [likelihood.waves(places, omegas, order=order) for order in (1, 2)]
    hidden = _HIDDEN / math.sqrt(independent_samples(band.weights, band.n_blocks))
    while True:
        rest = likelihood.beside(places, omegas, omega, tuple(orders.tolist()))
        scale, outside = rest.dimensions * (band.weights / rest.power), [rest.outside(each) for each in derivatives]
        errors_of = [
            scale @ (powers * moment * band.width[:, None] ** (2 * order) * _sizes(each))
            for order, (moment, each) in enumerate(zip(_MOMENTS, outside, strict=True), 1)
        ]
        errors = np.sum(errors_of, axis=0)
        k = int(np.where(orders < len(_MOMENTS), errors, 0).argmax())
        is_left = rest.dimensions - 1 >= max(2, _LEFT * likelihood.dimensions) and orders[k] < len(_MOMENTS)
        if errors[k] > hidden and is_left:
            changes = outside[orders[k]][:, :, k : k + 1]
            heard = scale @ (rest.powers_of(changes, changes)[:, 0, 0] / _sizes(changes)[:, 0])
            is_left = heard <= 1 + _MARGIN * errors_of[orders[k]][k] + _FLUCTUATION * hidden
        if errors[k] <= hidden or not is_left:
            return rest, float(_MARGIN * errors.sum()) if errors.sum() > hidden else 0.0
        orders[k] += 1


def _sizes(waves: NDArray[np.complex128]) -> Floats:
    """Return the squared magnitudes of waves: (bin, source)."""
    return np.asarray(np.maximum((waves.real**2 + waves.imag**2).sum(axis=1), _LEAST))


def beside_others(likelihood: BandLikelihood, places: Floats, k: int, band: HeardBand) -> BandLikelihood:
    """Return the likelihood of source k given the others."""
    others, omegas = np.delete(places, k, axis=0), np.delete(band.omegas, k, axis=1)
    return beside_sources(likelihood, others, omegas, band, band.omegas[:, k])[0]
