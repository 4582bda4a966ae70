"""Reference implementations: slow, simple, in float64, and independent of kernels and stages.

`exact` computes the image that the fast chain approximates, without decimation. It applies the matched filter to the
spectrum of the bits, delays it by exact phase shifts, and evaluates it at the given ranges. `paper` computes the image
of the paper's algorithm. The other functions are the references of single kernels.
"""

import functools
import hashlib
import math

import numpy as np
import scipy.signal
from ertis_bench.error_trials import reference_image
from ertis_bench.error_trials.reference_image import signals_of

from ertis_numba.geometry import array_weights, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Settings


def error_db(image, exact) -> float:
    """Norm of the difference relative to the norm of the exact image, in dB."""
    return float(20 * np.log10(np.linalg.norm(image - exact) / np.linalg.norm(exact)))


def exact(words, settings: Settings, directions, range_m, *, spherical=False, delay_rate_hz=None):
    """Compute the exact image: (direction, range) float64.

    Parameters
    ----------
    words : (sample,) or (sample, word) unsigned, or (sample, channel) PCM
    directions : (direction, axis) unit vectors
    range_m : (range,)
    spherical : bool
        Use the delays of points at their ranges instead of those of plane waves.
    delay_rate_hz : float
        Round the delays of plane waves to integer samples at this rate.
    """
    given = [np.ascontiguousarray(values) for values in (words, directions, range_m)]
    # The cache ignores device and plan, which only change the approximation of the exact image.
    sensor = settings.array, settings.call, settings.recording, settings.air
    given.append(array_weights(settings))
    return _exact(*map(_Same, given), *sensor, spherical, delay_rate_hz)


class _Same:
    """A hashable array that equals arrays of the same bytes, for use as a cache key."""

    def __init__(self, values):
        self.values = values
        self._key = values.shape, values.dtype.str, hashlib.sha256(values.tobytes()).digest()

    def __hash__(self):
        return hash(self._key)

    def __eq__(self, other):
        return self._key == other._key


@functools.lru_cache(maxsize=32)
def _exact(words, directions, range_m, weights, array, call, recording, air, spherical, delay_rate_hz):
    words, directions, range_m = words.values, directions.values, range_m.values
    spectra, frequency_hz = reference_image.calibrated_spectra(words, array, call, recording, None)
    spectra = spectra * weights.values[:, None]
    positions_m, speed_m_s = microphones(array).enabled_positions_m, sound_speed_m_s(air)
    at_range = np.exp(2j * np.pi * frequency_hz * (2 * range_m / speed_m_s)[:, None])  # (range, bin)
    image = np.empty((len(directions), len(range_m)))
    for index, direction in enumerate(directions):
        delay_s = reference_image.delays_s(positions_m, direction, range_m if spherical else None, speed_m_s)
        if spherical:
            image[index] = reference_image.amplitudes(reference_image.delayed(spectra, frequency_hz, at_range, delay_s))
            continue
        if delay_rate_hz:
            delay_s = np.rint(delay_s * delay_rate_hz) / delay_rate_hz
        image[index] = np.abs(at_range @ (spectra * np.exp(2j * np.pi * frequency_hz * delay_s)).mean(axis=0))
    image.flags.writeable = False
    return image


def paper(words, settings: Settings, directions):
    """Compute the image of the paper's algorithm and its range axis: (direction, range), (range,) float64.

    All filters and correlations work in the time domain, on one microphone and one direction at a time.
    """
    layout = microphones(settings.array)
    rate_hz, speed_m_s = settings.signal_rate_hz, sound_speed_m_s(settings.air)
    step = settings.output_decimation
    signals = (
        signals_of(words, np.flatnonzero(layout.enabled), settings.recording) / layout.gain[layout.enabled][:, None]
    )
    signals = signals * array_weights(settings)[:, None]
    padded_s = settings.call.end_s + 40 / (settings.call.high_frequency_hz - settings.call.low_frequency_hz)
    emitted = call_at(
        settings.call, np.arange(int(padded_s * settings.recording.sample_rate_hz)) / settings.recording.sample_rate_hz
    )
    call = _paper_filters(emitted, settings)
    low_pass, late = _paper_low_pass(settings)
    pulse = np.abs(np.correlate(call, call, "full"))
    peak = scipy.signal.sosfilt(low_pass, np.append(pulse, np.zeros(late)))[len(call) - 1 + late]
    n_samples = -(-signals.shape[1] // settings.decimation)
    at = np.arange(n_samples + late)
    outputs = np.arange(0, n_samples, step)
    image = np.zeros((len(directions), len(outputs)))
    matched = [np.correlate(_paper_filters(signal, settings), call, "full") for signal in signals]
    for index, direction in enumerate(directions):
        delay_s = -(layout.enabled_positions_m @ direction) / speed_m_s + layout.delay_s[layout.enabled]
        beam = np.zeros(len(at))
        for row, delay in zip(matched, np.rint(delay_s * rate_hz).astype(int), strict=True):
            place = at + delay + len(call) - 1  # lag 0 of a full correlation
            beam += np.where(place < len(row), row[np.clip(place, 0, len(row) - 1)], 0)
        image[index] = scipy.signal.sosfilt(low_pass, np.abs(beam) / (peak * len(matched)))[outputs + late]
    range_m = outputs * speed_m_s / (2 * rate_hz)
    first_m, last_m = settings.processing.range_m
    inside = (range_m > first_m - 1e-9) & (range_m < last_m + 1e-9)
    return image[:, inside], range_m[inside]


def _paper_filters(signal, settings):
    """Apply a Butterworth low pass, decimate, and apply a Butterworth band pass."""
    rate_hz, call = settings.signal_rate_hz, settings.call
    low_pass_hz = max(100e3 / 450e3 * rate_hz, call.high_frequency_hz)
    low_pass = scipy.signal.butter(6, low_pass_hz, fs=settings.recording.sample_rate_hz, output="sos")
    band = (call.low_frequency_hz, call.high_frequency_hz)
    band_pass = scipy.signal.butter(6, band, "bandpass", fs=rate_hz, output="sos")
    slow = scipy.signal.sosfilt(low_pass, signal)[:: settings.decimation]
    return scipy.signal.sosfilt(band_pass, slow)


def _paper_low_pass(settings):
    """Design the Butterworth low pass of the envelope; return its sections and its delay in samples."""
    cutoff_hz = min(settings.output_rate_hz / 2, settings.call.low_frequency_hz)
    sections = scipy.signal.butter(6, cutoff_hz, fs=settings.signal_rate_hz, output="sos")
    impulse = scipy.signal.sosfilt(sections, np.eye(1, 100_000)[0])
    return sections, round(float(np.arange(len(impulse)) @ impulse / impulse.sum()))  # delay of its centre of mass


def decimate(signals, taps, factor):
    """Filter and decimate signals; the result is late by the filter's group delay."""
    filtered = [np.convolve(signal.astype(float), taps.astype(float))[: len(signal)] for signal in signals]
    return np.stack(filtered)[:, ::factor]


def delay_and_sum(signals, offsets, weights, n_ranges):
    """Compute the complex beams: (direction, range) complex128."""
    flat = signals.reshape(-1).astype(complex)
    beams = np.zeros((len(offsets), n_ranges), dtype=complex)
    for direction, (starts, factors) in enumerate(zip(offsets, weights.astype(complex), strict=True)):
        for start, factor in zip(starts, factors, strict=True):
            beams[direction] += factor * flat[start : start + n_ranges]
    return beams


def delayed(signals, offsets, weights, n_ranges):
    """Select and weight the samples of each beam: (direction, mic, range) complex128."""
    flat = signals.reshape(-1).astype(complex)
    return flat[offsets[:, :, None] + np.arange(n_ranges)] * weights.astype(complex)[:, :, None]


def coherence_factor(signals, offsets, weights, n_ranges):
    """Delay-and-sum times coherent / total power: (direction, range) float64; signals must not be 0."""
    return np.stack([reference_image.coherence_factor(y) for y in delayed(signals, offsets, weights, n_ranges)])


def dmas(signals, offsets, weights, order, n_ranges):
    """Sum of products over all combinations of microphones: (direction, range) float64; signals must not be 0."""
    z = delayed(signals / np.abs(signals).astype(float) ** (1 - 1 / order), offsets, weights, n_ranges)
    return np.stack([math.comb(len(rows), order) * reference_image.dmas(rows, order) for rows in z])


def capon(signals, offsets, weights, n_snapshots, loading, n_ranges):
    """Capon beams from the full covariance matrix: (direction, range) float64; signals must not be 0."""
    return np.stack(
        [reference_image.capon(y, n_snapshots, loading) for y in delayed(signals, offsets, weights, n_ranges)]
    )


def interpolated_beams(signals, offsets, weights, places, tap_weights, rows, n_ranges):
    """Beams of the beam grid, interpolated to all directions: (direction, range) complex128."""
    nodes = delay_and_sum(signals, offsets, weights, n_ranges)
    return _of_pairs(nodes, places, tap_weights, rows)


def interpolated_whole_beams(tile, offsets, weights, places, tap_weights, rows, n_ranges):
    """Interpolated beams from an integer tile; grid beams keep their upper 16 bits: (direction, range) complex128.

    Parameters
    ----------
    tile : (mic, phase, k, 2) int16
    weights : (node, term, 2, 2) int16
    """
    flat = tile.reshape(-1, 2).astype(np.int64)
    nodes = np.zeros((len(offsets), n_ranges), dtype=complex)
    for node, (starts, factors) in enumerate(zip(offsets, weights.astype(np.int64), strict=True)):
        parts = sum(factor @ flat[start : start + n_ranges].T for start, factor in zip(starts, factors, strict=True))
        upper = (parts + 2**15) // 2**16
        nodes[node] = upper[0] + 1j * upper[1]
    return _of_pairs(nodes, places, tap_weights, rows)


def _of_pairs(nodes, places, tap_weights, rows):
    """Interpolate beams between neighbouring grid points, each into its row: (direction, range) complex128."""
    beams = np.zeros((len(rows), nodes.shape[1]), dtype=complex)
    for pair, k in np.ndindex(tap_weights.shape[1:]):
        beams[rows] += tap_weights[:, pair, k, None].astype(float) * nodes[places[:, pair] + k]
    return beams
