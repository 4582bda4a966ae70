"""Errors of delayed samples with fitted and with textbook weights, from the definition of the error in float64."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.interpolation_fit import DelayFit, Spectrum

TEXTBOOK = {
    "nearest sample": (1, False),
    "nearest sample, carrier rotated": (1, True),
    "linear between rotated carriers": (2, True),
    "cubic between rotated carriers": (4, True),
}
"""Textbook weights: number of samples, and whether their carriers are rotated to the phase of the delayed sample."""

_N_DELAYS = 1000


def textbook_error(spectrum: Spectrum, step_s: float, name: str) -> float:
    """Return the error power of weights in `TEXTBOOK`, which are Lagrange polynomials."""
    n_taps, rotated = TEXTBOOK[name]
    taps, fractions = np.arange(n_taps), _fractions(n_taps)
    weights = np.ones((n_taps, _N_DELAYS))
    for tap in taps:
        for other in taps[taps != tap]:
            weights[tap] *= (fractions - other) / (tap - other)
    carrier = 2j * math.pi * step_s * (spectrum.centre_hz if rotated else 0.0)
    return _error(spectrum, step_s, weights * np.exp(carrier * (fractions - taps[:, None])), np.ones(1))


def fitted_error(spectrum: Spectrum, step_s: float, n_taps: int) -> float:
    """Return the error power of the weights that plans use."""
    fit = DelayFit(n_taps, step_s, spectrum)
    return _error(spectrum, step_s, fit.weights(_fractions(n_taps)).T, fit.gain(spectrum.frequency_hz))


def _fractions(n_taps: int) -> NDArray[np.float64]:
    """Return delays after the first tap, in steps, spread evenly over the middle step of the taps."""
    return (np.arange(_N_DELAYS) + 0.5) / _N_DELAYS + n_taps / 2 - 1


def _error(spectrum: Spectrum, step_s: float, weights: NDArray[Any], gain: NDArray[Any]) -> float:
    """Return the power of g Σ c exp(2πi f k Δ) − exp(2πi f δ), averaged over delays δ and the spectrum of the call."""
    phase = 2j * math.pi * step_s * spectrum.frequency_hz[:, None]
    made = gain[:, None] * (np.exp(phase * np.arange(len(weights))) @ weights)
    wrong = made - np.exp(phase * _fractions(len(weights)))
    return float(spectrum.power @ np.mean(np.abs(wrong) ** 2, axis=1))
