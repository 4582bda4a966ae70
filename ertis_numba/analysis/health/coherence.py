"""Similarity of the signals of microphones around an arrival, by correlation with their mean."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ertis_numba.analysis.health.arrival import Compressed
from ertis_numba.base import fourier

__all__ = ["Coherence", "aligned", "correlate", "half_bands", "half_gate", "mean_of"]

_LAG_STEP_S = 1e-6
_NEAR_ZERO_S = 10e-6
_GATE_PERIODS = 2.0  # Length of the gate on either side, in units of 1 / bandwidth.


@dataclass(frozen=True, slots=True, eq=False)
class Coherence:
    """Correlation of real signals (mic,) with a reference: its highest value and lag, and the same by their powers."""

    # `at_zero`, `negative` and `opposite`: the highest, the magnitude of the lowest, and the latter by the powers, at
    # lags within 10 µs.

    lag_s: NDArray[np.float64]
    peak: NDArray[np.float64]
    coherence: NDArray[np.float64]
    at_zero: NDArray[np.float64]
    negative: NDArray[np.float64]
    opposite: NDArray[np.float64]


def half_gate(found: Compressed, lag_s: float) -> tuple[int, int]:
    """Return half of the gate and the largest lag, both in steps."""
    band_hz = found.frequency_hz[-1] - found.frequency_hz[0]
    return max(4, round(_GATE_PERIODS / band_hz / found.step_s)), int(np.ceil(lag_s / found.step_s))


def aligned(found: Compressed, at_s: NDArray[np.float64], lag_s: float) -> NDArray[np.complex128]:
    """Return the complex baseband signal of each microphone around its time ``at_s``: (mic, step) complex128."""
    half, n_steps = sum(half_gate(found, lag_s)), found.envelope.shape[1]
    steps = np.arange(-half, half + 1)
    turned = found.bins * np.exp(2j * np.pi * found.frequency_hz * (at_s - found.origin_s)[:, None])
    low_hz, centre_hz = found.frequency_hz[0], found.frequency_hz.mean()
    signals = fourier.ifft(turned, n_steps)[:, steps % n_steps]
    return np.asarray(signals * np.exp(2j * np.pi * (low_hz - centre_hz) * found.step_s * steps))


def half_bands(found: Compressed) -> tuple[Compressed, Compressed]:
    """Return the lower and the upper half of the band."""
    middle = len(found.frequency_hz) // 2
    lower = replace(found, bins=found.bins[:, :middle], frequency_hz=found.frequency_hz[:middle])
    return lower, replace(found, bins=found.bins[:, middle:], frequency_hz=found.frequency_hz[middle:])


def mean_of(wide: NDArray[np.complex128], found: Compressed, lag_s: float) -> NDArray[np.complex128]:
    """Return the mean of the microphones within the gate, each normalised to equal power: (step,) complex128."""
    _, lags = half_gate(found, lag_s)
    gated = wide[:, lags : wide.shape[1] - lags]
    return np.asarray(np.mean(gated / np.sqrt(np.sum(np.abs(gated) ** 2, axis=1))[:, None], axis=0))


def correlate(
    wide: NDArray[np.complex128], reference: NDArray[np.complex128], found: Compressed, lag_s: float
) -> Coherence:
    """Return the correlations of microphones with a reference, at lags within ``± lag_s``."""
    windows = sliding_window_view(wide, len(reference), axis=1)
    product = windows @ np.conj(reference)
    norm = np.sqrt(np.sum(np.abs(windows) ** 2, axis=2) * np.sum(np.abs(reference) ** 2))
    _, lags = half_gate(found, lag_s)
    coarse_s = np.arange(-lags, lags + 1) * found.step_s
    fine_s = np.arange(-lag_s, lag_s + _LAG_STEP_S / 2, _LAG_STEP_S)
    carrier = np.exp(2j * np.pi * found.frequency_hz.mean() * fine_s)
    real = np.stack([(np.interp(fine_s, coarse_s, row) * carrier).real for row in product])
    norms = np.stack([np.interp(fine_s, coarse_s, row) for row in norm])
    mics, best = np.arange(len(wide)), np.argmax(real, axis=1)
    near = np.abs(fine_s) <= _NEAR_ZERO_S
    lowest = np.argmin(real[:, near], axis=1)
    negative = -real[:, near][mics, lowest]
    return Coherence(
        lag_s=fine_s[best],
        peak=real[mics, best],
        coherence=real[mics, best] / norms[mics, best],
        at_zero=real[:, near].max(axis=1),
        negative=negative,
        opposite=negative / norms[:, near][mics, lowest],
    )
