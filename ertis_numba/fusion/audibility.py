"""Threshold above which a pulse within a window is not noise."""

import math
from typing import Final

import numpy as np
import scipy

from ertis_numba.geometry.waveform import matched_filter_spectrum
from ertis_numba.settings import Settings

__all__ = ["audible_ratio"]

_RATIOS: Final = 1.0, 1e6  # Limits of thresholds.


def audible_ratio(settings: Settings, *, searched_s: float, averaged_s: float, false_alarms: float) -> float:
    """Return the threshold of an amplitude relative to the background, with ``false_alarms`` per window by noise alone.

    The envelope of Gaussian noise with the RMS bandwidth B rises above ρ times its RMS at the rate ``2 √π B ρ
    exp(-ρ²)`` (Rice, Mathematical Analysis of Random Noise, 1945, section 3.4). The measured power of the background is
    uncertain. Relative to its mean, it has a gamma distribution with the shape K, the number of independent values in
    the averaged time. The mean rate is then ``2 √π B ρ Γ(K + ½) / (Γ(K) √K) (1 + ρ² / K)^-(K + ½)``. Multiplied by the
    searched time, it is an upper limit of the probability that noise exceeds the threshold.
    """
    rms_hz, independent = _noise(settings, averaged_s)
    low, high = np.log(_RATIOS)
    goal = math.log(false_alarms)
    found = scipy.optimize.brentq(
        lambda ratio: _log_rate(math.exp(ratio), rms_hz * searched_s, independent) - goal, low, high, xtol=1e-6
    )
    return math.exp(found)


def _log_rate(ratio: float, searched: float, independent: float) -> float:
    """Return the logarithm of the mean number of times that noise rises above a threshold."""
    uncertain = (
        scipy.special.gammaln(independent + 0.5) - scipy.special.gammaln(independent) - math.log(independent) / 2
    )
    tail = (independent + 0.5) * math.log1p(ratio**2 / independent)
    return float(math.log(2 * math.sqrt(math.pi) * searched * ratio) + uncertain - tail)


def _noise(settings: Settings, averaged_s: float) -> tuple[float, float]:
    """Return the RMS bandwidth of filtered white noise in hertz, and the number of independent values of its power."""
    n_fft = 2 ** math.ceil(math.log2(4 * settings.call.end_s * settings.signal_rate_hz))
    spacing_hz = settings.signal_rate_hz / n_fft
    power = np.abs(matched_filter_spectrum(settings, n_fft=n_fft).values) ** 2
    frequency_hz = np.arange(len(power)) * spacing_hz
    centre_hz = np.average(frequency_hz, weights=power)
    rms_hz = float(np.sqrt(np.average((frequency_hz - centre_hz) ** 2, weights=power)))
    return rms_hz, float(averaged_s * spacing_hz * power.sum() ** 2 / np.sum(power**2))
