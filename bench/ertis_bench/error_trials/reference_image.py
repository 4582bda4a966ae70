"""Slow float64 reference for exact images, independent of all stages and written according to the documentation.

It neither decimates nor plans. It matches the spectrum of the samples themselves, delays it by exact phase shifts, and
sums it bin by bin at each range.
"""

import itertools
from typing import Any, Final

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ertis_numba.geometry import array_weights, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.pipeline.verification import combine
from ertis_numba.settings import Array, Call, Processing, Recording, Settings

__all__ = ["amplitudes", "beamformed", "capon", "coherence_factor", "dmas", "exact", "signals_of", "unpack_bits"]

Floats = NDArray[np.float64]
Delayed = NDArray[np.complex128]

_DEFINED: Final = frozenset({"delay_and_sum", "dmas", "capon"})
_WEIGHTINGS: Final = frozenset({"none", "coherence_factor"})
"""Beamformers with a second definition here; `verification` defines the others."""


def exact(words: NDArray[Any], settings: Settings, directions: Floats, range_m: Floats) -> Floats:
    """Return the exact image: (direction, range) float64.

    Parameters
    ----------
    words : (sample,) or (sample, word) unsigned, or (sample, channel) PCM
    settings : Settings
    directions : (direction, axis) float64
        Unit vectors.
    range_m : (range,) float64
    """
    spherical, edges_hz = settings.processing.wavefront == "spherical", settings.processing.band_edges_hz
    spectra, frequency_hz = calibrated_spectra(words, settings.array, settings.call, settings.recording, edges_hz)
    spectra = spectra * array_weights(settings)[:, None]
    positions_m, speed_m_s = microphones(settings.array).enabled_positions_m, sound_speed_m_s(settings.air)
    at_range = np.exp(2j * np.pi * frequency_hz * (2 * range_m / speed_m_s)[:, None])  # (range, bin)
    image = np.empty((len(directions), len(range_m)))
    for index, direction in enumerate(directions):
        delay_s = delays_s(positions_m, direction, range_m if spherical else None, speed_m_s)
        image[index] = beamformed(delayed(spectra, frequency_hz, at_range, delay_s), settings.processing)
    return image


def delays_s(positions_m: Floats, direction: Floats, range_m: Floats | None, speed_m_s: float) -> Floats:
    """Return delays relative to the centroid: (mic, 1) for plane waves, or (mic, range) for points at ranges."""
    if range_m is None:
        return np.asarray(-(positions_m @ direction)[:, None] / speed_m_s)
    points_m = range_m[:, None] * direction - positions_m[:, None]
    return np.asarray((np.linalg.norm(points_m, axis=-1) - range_m) / speed_m_s)


def delayed(spectra: Delayed, frequency_hz: Floats, at_range: Delayed, delay_s: Floats) -> Delayed:
    """Return the delayed signals of a direction: (mic, range) complex128."""
    out = np.empty((len(spectra), len(at_range)), dtype=np.complex128)
    for mic, (spectrum, delay) in enumerate(zip(spectra, delay_s, strict=True)):
        turns = np.exp(2j * np.pi * frequency_hz * delay[:, None])  # (1 or range, bin)
        out[mic] = at_range @ (spectrum * turns[0]) if len(turns) == 1 else (at_range * turns) @ spectrum
    return out


def calibrated_spectra(
    words: NDArray[Any], array: Array, call: Call, recording: Recording, edges_hz: tuple[float, float] | None
) -> tuple[Delayed, Floats]:
    """Return spectra and their frequencies after the matched filter.

    Delays and gains of microphones are corrected.
    """
    layout = microphones(array)
    signals = signals_of(words, np.flatnonzero(layout.enabled), recording)
    spectra, frequency_hz = _matched_spectra(signals, call, recording.sample_rate_hz, edges_hz)
    spectra = spectra * np.exp(2j * np.pi * frequency_hz * layout.delay_s[layout.enabled][:, None])
    return spectra / layout.gain[layout.enabled][:, None], frequency_hz


def _matched_spectra(
    signals: Floats, call: Call, rate_hz: float, edges_hz: tuple[float, float] | None
) -> tuple[Delayed, Floats]:
    """Return one-sided spectra after the matched filter, and their frequencies.

    ``y(t) = Σ_f Y(f) exp(2πjft)`` is analytic, with an envelope of 1 where the signal is the call itself.
    """
    width_hz = min(5_000.0, call.low_frequency_hz / 2)
    low_hz, high_hz = edges_hz or (call.low_frequency_hz - width_hz, call.high_frequency_hz + width_hz)
    ringing_s = 100 / min(call.low_frequency_hz - low_hz, high_hz - call.high_frequency_hz)
    n_fft = scipy.fft.next_fast_len(2 * signals.shape[1] + int((ringing_s + call.end_s) * rate_hz))
    frequency_hz = np.arange(n_fft // 2 + 1) * rate_hz / n_fft
    inside = (frequency_hz > low_hz) & (frequency_hz < high_hz)
    frequency_hz = frequency_hz[inside]
    outside = np.maximum(
        (call.low_frequency_hz - frequency_hz) / (call.low_frequency_hz - low_hz),
        (frequency_hz - call.high_frequency_hz) / (high_hz - call.high_frequency_hz),
    )
    window = np.where(outside > 0, 0.5 + 0.5 * np.cos(np.pi * outside), 1.0)
    emitted = call_at(call, np.arange(int(call.end_s * rate_hz) + 2) / rate_hz)
    response = np.conj(scipy.fft.rfft(emitted, n_fft)[inside]) * window
    response /= np.sum(np.abs(response) ** 2 / np.where(window > 0, window, 1.0))
    return np.asarray(scipy.fft.rfft(signals, n_fft)[:, inside] * response), frequency_hz


def beamformed(y: Delayed, processing: Processing) -> Floats:
    """Return the amplitude of one direction: (mic, range) to (range,). The signals must not be silent."""
    if processing.beamformer not in _DEFINED or processing.weighting not in _WEIGHTINGS:
        return combine(y, processing)
    factor = coherence_factor(y) if processing.weighting == "coherence_factor" else 1.0
    return factor * _unweighted(y, processing)


def _unweighted(y: Delayed, processing: Processing) -> Floats:
    if processing.beamformer == "delay_and_sum":
        return amplitudes(y)
    if processing.beamformer == "dmas":
        return dmas(y / np.abs(y) ** (1 - 1 / processing.dmas_order), processing.dmas_order)
    return capon(y, processing.snapshots, processing.diagonal_loading)


def amplitudes(y: Delayed) -> Floats:
    """Return the amplitude of delay-and-sum."""
    return np.asarray(np.abs(y.mean(axis=0)))


def coherence_factor(y: Delayed) -> Floats:
    """Return the coherent power relative to the total power."""
    return np.asarray(np.abs(y.sum(axis=0)) ** 2 / (len(y) * (np.abs(y) ** 2).sum(axis=0)))


def dmas(z: Delayed, order: int) -> Floats:
    """Return the mean of the products of all combinations of roots, computed term by term."""
    choices = np.array(list(itertools.combinations(range(len(z)), order)))
    return np.asarray(np.abs(np.prod(z[choices], axis=1).mean(axis=0)))


def capon(y: Delayed, n_snapshots: int, loading: float) -> Floats:
    """Return the beam with the weights of least variance, from the whole covariance matrix."""
    n_mics, n_ranges = y.shape
    image, n_snapshots = np.empty(n_ranges), min(n_snapshots, n_ranges)
    for place in range(n_ranges):
        first = min(max(place - n_snapshots // 2, 0), n_ranges - n_snapshots)
        window = y[:, first : first + n_snapshots]
        covariance = window @ window.conj().T / n_snapshots
        covariance += loading * np.trace(covariance) / n_mics * np.eye(n_mics)
        w = np.linalg.solve(covariance, np.ones(n_mics))
        image[place] = np.abs((w / w.sum()).conj() @ y[:, place])
    return image


def signals_of(words: NDArray[Any], channels: NDArray[np.intp], recording: Recording) -> Floats:
    """Return the signals of bits or numbers, relative to full scale: (mic, sample) float64."""
    if recording.is_pdm:
        return unpack_bits(words, channels)
    return np.asarray(words[:, channels].T / recording.full_scale, np.float64)


def unpack_bits(words: NDArray[Any], channels: NDArray[np.intp]) -> Floats:
    """Return the signals of +1 and -1: (mic, sample) float64."""
    words = words.reshape(len(words), -1)
    word_bits = words.dtype.itemsize * 8
    return np.stack(
        [
            ((words[:, channel // word_bits] >> words.dtype.type(channel % word_bits)) & words.dtype.type(1)) * 2.0
            - 1.0
            for channel in channels
        ]
    )
