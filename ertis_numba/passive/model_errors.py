"""Errors of the model that each bin contains one wave of a source, as far as they may look like further sources."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.passive.detection_law import independent_samples
from ertis_numba.passive.heard_band import HeardBand
from ertis_numba.passive.likelihood import BandLikelihood

__all__ = ["beside_others", "beside_sources", "inverse_ranges"]

Floats = NDArray[np.float64]

_HIDDEN: Final = 0.1  # Error relative to a standard deviation of the power of noise that causes no further alarms.
_MOMENTS: Final = (  # Mean squares of the factors of derivatives.
    (1.0, 0.75),  # Gaussian frequencies x with variance 1: that of x, and that of x² / 2 with its mean
    (1.0, 1 / 4, 1 / 36),  # 1/range with a value of 1: it, its square / 2, and its cube / 6
)
_LEFT: Final = 2 / 3  # Least share of the dimensions that is left for further sources.
_FLUCTUATION: Final = 40.0  # Four standard deviations of the power of noise, relative to hidden errors.
_LEAST: Final = 1e-30
_MARGIN: Final = 2.0  # Largest power of errors relative to that expected.


def beside_sources(
    likelihood: BandLikelihood, places: Floats, omegas: Floats, band: HeardBand, omega: Floats
) -> tuple[BandLikelihood, float]:
    """Return the likelihood of further sources, and the largest power of errors in a beam relative to that of noise."""
    # Waves of a source whose frequency varies, or from a range of 1 m on, lie in the space of the wave and its
    # derivatives. Derivatives that stand out of the noise are left out, as long as two thirds of the dimensions remain.
    orders = np.zeros((len(places), 2), np.intp)
    if not len(places):
        return likelihood.beside(places, omegas, omega), 0.0
    powers = np.maximum(likelihood.separated(places, omegas)[0], 0)
    most = [len(moments) for moments in _MOMENTS]
    derivatives = [
        [likelihood.waves(places, omegas, order=order + 1, curved=curved) for order in range(most[curved])]
        for curved in (False, True)
    ]
    rest = likelihood.beside(places, omegas, omega)
    per_m = inverse_ranges(rest, rest.power / rest.dimensions, powers, derivatives[1][0], band)
    spreads = np.broadcast_to(band.width[:, None], powers.shape), np.broadcast_to(per_m, powers.shape)
    hidden = _HIDDEN / math.sqrt(independent_samples(band.weights, band.n_blocks))
    while True:
        rest = likelihood.beside(places, omegas, omega, tuple((int(a), int(b)) for a, b in orders))
        scale = rest.dimensions * (band.weights / rest.power)
        outside = [[rest.outside(each) for each in of_kind] for of_kind in derivatives]
        errors_of = [
            [
                scale @ (powers * moment * spread ** (2 * order) * _sizes(each))
                for order, (moment, each) in enumerate(zip(moments, of_kind, strict=True), 1)
            ]
            for moments, spread, of_kind in zip(_MOMENTS, spreads, outside, strict=True)
        ]
        errors = np.array([np.sum(of_kind, axis=0) for of_kind in errors_of]).T
        k, kind = np.unravel_index(np.where(orders < most, errors, 0).argmax(), errors.shape)
        order = orders[k, kind]
        is_left = rest.dimensions - 1 >= max(2, _LEFT * likelihood.dimensions) and order < most[kind]
        if errors[k, kind] > hidden and is_left:
            changes = outside[kind][order][:, :, k : k + 1]
            heard = scale @ (rest.powers_of(changes, changes)[:, 0, 0] / _sizes(changes)[:, 0])
            is_left = heard <= 1 + _MARGIN * errors_of[kind][order][k] + _FLUCTUATION * hidden
        if errors[k, kind] <= hidden or not is_left:
            return rest, float(_MARGIN * errors.sum()) if errors.sum() > hidden else 0.0
        orders[k, kind] += 1


def inverse_ranges(
    rest: BandLikelihood, noise: Floats, powers: Floats, curvatures: NDArray[np.complex128], band: HeardBand
) -> Floats:
    """Return the largest 1/range in 1/m, at most 1, that derivatives of waves by it show: (source,)."""
    scale, curvatures = band.weights / noise, rest.outside(curvatures)
    sizes = _sizes(curvatures)
    heard = scale @ (np.einsum("kms,kms->ks", curvatures.conj(), rest.matrix @ curvatures).real / sizes)
    fluctuation = _FLUCTUATION * _HIDDEN / math.sqrt(independent_samples(band.weights, band.n_blocks))
    largest = np.maximum(scale @ (powers * sizes), _LEAST)
    return np.asarray(np.sqrt(np.clip((heard - 1 + fluctuation) / largest, 0, 1)))


def _sizes(waves: NDArray[np.complex128]) -> Floats:
    """Return the squared magnitudes of waves: (bin, source)."""
    return np.asarray(np.maximum((waves.real**2 + waves.imag**2).sum(axis=1), _LEAST))


def beside_others(likelihood: BandLikelihood, places: Floats, k: int, band: HeardBand) -> BandLikelihood:
    """Return the likelihood of source k given the others."""
    others, omegas = np.delete(places, k, axis=0), np.delete(band.omegas, k, axis=1)
    return beside_sources(likelihood, others, omegas, band, band.omegas[:, k])[0]
