"""Output of the matched filter for calls: the band, the pulse and its side lobes."""

import functools
import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry.waveform import MatchedFilterSpectrum, call_spectrum, matched_band_hz, matched_filter_spectrum
from ertis_numba.settings import Call, Settings
from ertis_numba.simulation.arrivals import CallFilter

__all__ = ["N_NODES", "band", "baseband", "envelope", "match", "matched"]

Floats = NDArray[np.float64]

N_NODES = 65
"""Frequencies at which echoes are compared."""


@functools.lru_cache(maxsize=16)
def match(settings: Settings) -> tuple[MatchedFilterSpectrum, float, int]:
    """Return the matched filter of the sensor's own call, its sample rate and the length of its transform."""
    rate_hz = settings.signal_rate_hz
    n_fft = 2 ** math.ceil(math.log2(2 * settings.call.end_s * rate_hz))
    return matched_filter_spectrum(settings, n_fft=n_fft), rate_hz, n_fft


def matched(settings: Settings, call: Call, filters: tuple[CallFilter, ...] = ()) -> NDArray[np.complex128]:
    """Return a call of amplitude 1, with filters of its emitter, after the matched filter from lag 0 on: (lag,)."""
    rate_hz = settings.signal_rate_hz
    rings_s = sum(each.rings_s for each in filters)
    n_fft = 2 ** math.ceil(math.log2(4 * (call.end_s + settings.call.end_s + rings_s) * rate_hz))
    mine = matched_filter_spectrum(settings, n_fft=n_fft)
    bins = slice(mine.first_bin, mine.first_bin + len(mine.values))
    spectrum = np.zeros(n_fft, dtype=np.complex128)
    spectrum[bins] = call_spectrum(call, settings, n_fft=n_fft)[bins] * mine.values
    for each in filters:
        spectrum[bins] *= each.response(np.arange(bins.start, bins.stop) * rate_hz / n_fft)
    return np.asarray(np.fft.ifft(spectrum))


@functools.lru_cache(maxsize=16)
def baseband(settings: Settings, filters: tuple[CallFilter, ...] = ()) -> tuple[Floats, NDArray[np.complex128]]:
    """Return lags in seconds, and the matched call without its carrier: (lag,) float64, (lag,) complex128."""
    pulse = np.fft.fftshift(matched(settings, settings.call, filters))
    lag_s = (np.arange(len(pulse)) - len(pulse) // 2) / settings.signal_rate_hz
    frequency_hz, power = band(settings)
    return lag_s, pulse * np.exp(-2j * math.pi * float(frequency_hz @ power) * lag_s)


@functools.lru_cache(maxsize=16)
def envelope(settings: Settings, filters: tuple[CallFilter, ...] = ()) -> tuple[Floats, Floats]:
    """Return lags from 0 on and the envelope of the matched call, with filters relative to its peak: (lag,)."""
    lag_s, pulse = baseband(settings, filters)
    middle = len(lag_s) // 2
    after = np.abs(pulse[middle:])
    return lag_s[middle:], after / after.max() if filters else after


@functools.lru_cache(maxsize=16)
def band(settings: Settings) -> tuple[Floats, Floats]:
    """Return frequencies of the call's band, and the fraction of the matched call's power at each."""
    rate_hz, n_fft = settings.signal_rate_hz, 32_768  # bins much narrower than a node
    mine = matched_filter_spectrum(settings, n_fft=n_fft)
    frequency_hz = (mine.first_bin + np.arange(len(mine.values))) * rate_hz / n_fft
    edges = np.linspace(*matched_band_hz(settings), N_NODES + 1)
    # The image sums S H; between the edges of its window H is conj(S).
    power, _ = np.histogram(frequency_hz, edges, weights=mine.echo_power)
    return (edges[:-1] + edges[1:]) / 2, power / power.sum()
