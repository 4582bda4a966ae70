"""Powers of sources in noise, and the errors of their directions."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.passive.detection_law import independent_samples
from ertis_numba.passive.heard_band import HeardBand
from ertis_numba.passive.likelihood import BandLikelihood
from ertis_numba.passive.model_errors import beside_others, inverse_ranges

__all__ = ["covariance_of", "powers_in_noise"]

Floats = NDArray[np.float64]

_LEAST: Final = 1e-30
_FLAT: Final = 1e-9  # Information relative to the largest, below which a direction is not resolved.
_ROUNDING: Final = 3e-7  # of powers in single precision
_SIGNIFICANT: Final = 5.0  # Power beyond noise relative to its standard deviation that shows several sources.
_AXIS_ERROR_RAD: Final = 0.05  # Error of the direction in which sources lie that are not separated.
_APART: Final = 0.1  # Changes of waves relative to their size from which on this error is at its largest.
_TURN_ERROR: Final = 0.25  # Error of the turn by a finite range, relative to it.
_OF_WIDTH: Final = 0.3  # Uncertain share of the power that the width of a bin causes.


def powers_in_noise(beside: BandLikelihood, place: Floats, width: Floats | None = None) -> tuple[Floats, Floats]:
    """Return the power of a source given all others, and the noise in each dimension, both (bin,)."""
    # Blocks of distant microphones hear slightly different sound, which is no noise if `width` (bin,) rad/s is given.
    powers, size = beside.beams(place[None])
    rest, n = beside.power - powers[:, 0], beside.dimensions - 1
    if width is not None and n > 1:
        wave, _, _ = beside.slopes(place)
        changes = beside.outside(beside.waves(place[None], order=1))
        changes = changes - wave * (wave.conj() * changes).sum(axis=1, keepdims=True) / size[:, None]
        sizes = np.maximum((changes.real**2 + changes.imag**2).sum(axis=(1, 2)), _LEAST)
        rest, n = rest - beside.powers_of(changes, changes)[:, 0, 0] / sizes, n - 1
    noise = np.maximum(rest / max(n, 1), _ROUNDING)
    return (powers[:, 0] - noise) / size[:, 0], noise


def covariance_of(likelihood: BandLikelihood, places: Floats, k: int, band: HeardBand, *, level: bool) -> Floats:
    """Return the covariance (2, 2) of direction k's errors sideways and upwards, infinite if not resolved."""
    # The gradient of the likelihood has the variance of products of the beam with the noise outside of it.
    place, beside = places[k], beside_others(likelihood, places, k, band)
    powers, noise = powers_in_noise(beside, place, band.width)
    powers, (_, changes, size) = np.maximum(powers, 0), beside.slopes(place)
    gains = band.weights * powers / noise
    if not gains.any():
        return np.diag([math.inf, math.inf])
    metrics = (changes.conj().transpose(0, 2, 1) @ changes).real
    metric = np.tensordot(gains / gains.sum(), metrics, 1)
    parts = band.weights * np.sqrt((size * powers / noise + 1) / size)
    samples = independent_samples(parts, band.n_blocks)
    scale = 2 * samples * (gains.sum() / parts.sum()) ** 2
    every = np.maximum(likelihood.separated(places, band.omegas)[0], 0)
    of_blocks = beside.waves(places, band.omegas, order=1) * (band.width[:, None] * np.sqrt(every))[:, None]
    across = changes.conj().transpose(0, 2, 1) @ beside.outside(of_blocks)
    # Noise in bins without sound of the source shows nothing of other sources.
    weights = band.weights * powers / (powers + noise)
    of_width, of_others = (
        np.tensordot(weights, (each @ each.conj().transpose(0, 2, 1)).real, 1)
        for each in (across, np.delete(across, k, axis=2))
    )
    of_noise = np.tensordot(weights * noise, metrics, 1)
    excess = np.tensordot(weights, beside.powers_of(changes, changes), 1) - of_noise - of_width
    limit = _SIGNIFICANT / math.sqrt(samples) * of_noise + _OF_WIDTH * of_width
    n = 1 if level else 2
    out = _inverse(scale * metric[:n, :n])
    spread = _of_excess(excess, limit, metric, float(weights @ powers))
    apart = min(1.0, float(np.trace(metric @ spread)) / (_APART * float(band.weights @ size)))
    out[:n, :n] += (spread + apart * _AXIS_ERROR_RAD**2 * np.trace(spread) * np.eye(2))[:n, :n]
    out[:n, :n] += _of_range(beside, place, powers, noise, metric[:n, :n], gains / gains.sum(), changes[..., :n], band)
    # Blocks of distant microphones hear different sound of other sources, which looks like noise.
    out[:n, :n] += _of_excess(of_others, 0 * limit, metric, scale * float(weights @ noise))[:n, :n]
    return out


def _of_range(
    beside: BandLikelihood,
    place: Floats,
    powers: Floats,
    noise: Floats,
    metric: Floats,
    weights: Floats,
    changes: NDArray[np.complex128],
    band: HeardBand,
) -> Floats:
    """Return the covariance of the turn of the direction by a range that is not infinite."""
    whole, curvature = (beside.waves(place[None], order=1, curved=True, part=part) for part in (0, 1))
    wave, _, size = beside.slopes(place)
    curvature = (
        curvature - wave * (wave.conj() * beside.outside(curvature)).sum(axis=1, keepdims=True) / size[:, None, None]
    )
    turn = np.linalg.pinv(metric) @ (weights @ (changes.conj().transpose(0, 2, 1) @ whole).real[..., 0])
    spread = np.outer(turn, turn) + _TURN_ERROR**2 * (turn @ turn) * np.eye(len(turn))
    return np.asarray(spread * inverse_ranges(beside, noise, powers[:, None], curvature, band)[0] ** 2)


def _of_excess(excess: Floats, limit: Floats, metric: Floats, power: float) -> Floats:
    """Return the covariance of directions for which changes of a wave have an excess of power; 0 below a limit."""
    values, vectors = np.linalg.eigh(metric)
    if values[-1] <= 0:
        return np.zeros((2, 2))
    seen = values > _FLAT * values[-1]
    whitening = vectors[:, seen] / np.sqrt(values[seen])
    powers, axes = np.linalg.eigh(whitening.T @ excess @ whitening)
    limits = np.einsum("ij,ik,kj->j", axes, whitening.T @ limit @ whitening, axes)
    kept = np.where(powers > limits, powers, 0.0)
    turned = whitening @ axes
    return np.asarray((turned * kept) @ turned.T / max(power, _LEAST))


def _inverse(information: Floats) -> Floats:
    """Return the covariance (2, 2), infinite along directions without information; one row has a given elevation."""
    out = np.diag([math.inf, math.inf])
    n = len(information)
    values, vectors = np.linalg.eigh(information)
    if values[0] > _FLAT * values[-1]:
        out[:n, :n] = (vectors / values) @ vectors.T
    elif values[-1] > 0:
        seen = np.flatnonzero(np.abs(vectors[:, 0]) <= math.sqrt(_FLAT))
        out[seen, seen] = 1 / values[-1]
    return out
