"""Errors of delayed samples with fitted weights, and with textbook weights that no plan contains.

This module evaluates the definition of the error in float64. It processes no measurement and measures no times.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_bench.markdown import table
from ertis_numba.settings import Settings
from ertis_numba.stages.error_model import decibels
from ertis_numba.stages.interpolation_fit import DelayFit, Spectrum
from ertis_numba.stages.plan_elements import spectrum_of

__all__ = ["FORMS", "TEXTBOOK", "fitted_error", "form", "run", "textbook_error"]

TEXTBOOK = {
    "nearest sample": (1, False),
    "nearest sample, carrier rotated": (1, True),
    "linear between rotated carriers": (2, True),
    "cubic between rotated carriers": (4, True),
}
"""Textbook weights: number of samples, and whether their carriers are rotated to the phase of the delayed sample."""

_FITTED = (1, 2, 3, 4)
_OVERSAMPLINGS = (1, 2, 4, 8, 16, 32)
_N_DELAYS = 1000


def run(*, say: Callable[[str], None]) -> dict[str, Any]:
    """Return the errors of all weights for the default call and the default rate of ranges."""
    settings = Settings.from_preset("default_25_50")
    spectrum, rate_hz = spectrum_of(settings), settings.output_rate_hz
    rows = []
    for n_phases in _OVERSAMPLINGS:
        say(f"{n_phases} samples per range")
        step_s = 1 / (rate_hz * n_phases)
        errors = {name: textbook_error(spectrum, step_s, name) for name in TEXTBOOK}
        errors |= {f"fitted, {n} tap{'s' * (n > 1)}": fitted_error(spectrum, step_s, n) for n in _FITTED}
        rows.append({"oversampling": n_phases, "error_db": {name: decibels(error) for name, error in errors.items()}})
    return {"rate_hz": rate_hz, "rows": rows}


def form(report: dict[str, Any]) -> str:
    """Return one row per kind of weights, with its error for each number of samples per range."""
    head = ["weights, error in dB", *(f"{row['oversampling']} per range" for row in report["rows"])]
    names = report["rows"][0]["error_db"]
    return table(head, [[name, *(f"{row['error_db'][name]:.1f}" for row in report["rows"])] for name in names])


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


FORMS = {"interpolation": form}
"""Forms of the table, by the name in its markers."""
