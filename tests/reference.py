"""The referees: slow, obvious, float64, and independent of kernels and stages.

`exact` is the image that the fast chain approximates. It never decimates: the spectrum of the bits themselves is
matched, delayed by exact phase shifts and evaluated at the asked ranges. `paper` is the image of the paper's
algorithm. The plain functions below them say what each kernel should do.
"""

import functools
import hashlib
import itertools

import numpy as np
import scipy.fft
import scipy.signal

from ertis_numba.air import sound_speed_m_s
from ertis_numba.geometry import microphones
from ertis_numba.settings import Settings
from ertis_numba.waveform import call_at


def error_db(image, exact) -> float:
    """Difference of two images in dB of the exact one's norm."""
    return float(20 * np.log10(np.linalg.norm(image - exact) / np.linalg.norm(exact)))


def exact(words, settings: Settings, directions, range_m, *, spherical=False, delay_rate_hz=None):
    """The exact image: (direction, range) float64.

    Parameters
    ----------
    words : (sample,) or (sample, word) unsigned, or (sample, channel) PCM
    directions : (direction, axis) unit vectors
    range_m : (range,)
    spherical : bool
        Delays of points at their ranges instead of plane waves.
    delay_rate_hz : float
        Round the delays of plane waves to whole samples of this rate.
    """
    given = [np.ascontiguousarray(values) for values in (words, directions, range_m)]
    # Devices and plans share the exact image of their words: plans are about how it is approximated.
    sensor = settings.array, settings.call, settings.recording, settings.air
    return _exact(*map(_Same, given), *sensor, spherical, delay_rate_hz)


class _Same:
    """An array that equals others of the same bytes."""

    def __init__(self, values):
        self.values = values
        self._key = values.shape, values.dtype.str, hashlib.sha256(values.tobytes()).digest()

    def __hash__(self):
        return hash(self._key)

    def __eq__(self, other):
        return self._key == other._key


@functools.lru_cache(maxsize=32)
def _exact(words, directions, range_m, array, call, recording, air, spherical, delay_rate_hz):
    words, directions, range_m = words.values, directions.values, range_m.values
    layout = microphones(array)
    speed_m_s = sound_speed_m_s(air)
    signals = signals_of(words, np.flatnonzero(layout.enabled), recording)
    spectra, frequency_hz = _matched_spectra(signals, call, recording.sample_rate_hz)
    spectra = spectra * np.exp(2j * np.pi * frequency_hz * layout.delay_s[layout.enabled][:, None])
    spectra /= layout.gain[layout.enabled][:, None] * len(spectra)
    positions_m = layout.enabled_positions_m
    at_range = np.exp(2j * np.pi * frequency_hz * (2 * range_m / speed_m_s)[:, None])  # (range, bin)
    image = np.empty((len(directions), len(range_m)))
    for index, direction in enumerate(directions):
        if spherical:
            points_m = range_m[:, None, None] * direction - positions_m
            delay_s = (np.linalg.norm(points_m, axis=-1) - range_m[:, None]) / speed_m_s
            beam = sum(
                (at_range * np.exp(2j * np.pi * frequency_hz * delay_s[:, mic, None])) @ spectra[mic]
                for mic in range(len(spectra))
            )
        else:
            delay_s = -(positions_m @ direction) / speed_m_s
            if delay_rate_hz:
                delay_s = np.rint(delay_s * delay_rate_hz) / delay_rate_hz
            beam = at_range @ (spectra * np.exp(2j * np.pi * frequency_hz * delay_s[:, None])).sum(axis=0)
        image[index] = np.abs(beam)
    image.flags.writeable = False
    return image


def _matched_spectra(signals, call, rate_hz):
    """One-sided spectra of the signals after the matched filter, and their frequencies.

    ``y(t) = Σ_f Y(f) exp(2πjft)`` is analytic, with an envelope of 1 where the signal is the call itself.
    """
    n_fft = scipy.fft.next_fast_len(2 * signals.shape[1] + int(0.02 * rate_hz))  # nothing wraps around
    frequency_hz = np.arange(n_fft // 2 + 1) * rate_hz / n_fft
    width_hz = min(5_000.0, call.low_frequency_hz / 2)
    outside_hz = np.maximum(call.low_frequency_hz - frequency_hz, frequency_hz - call.high_frequency_hz)
    inside = outside_hz < width_hz
    frequency_hz, outside_hz = frequency_hz[inside], outside_hz[inside]
    window = np.where(outside_hz > 0, 0.5 + 0.5 * np.cos(np.pi * outside_hz / width_hz), 1.0)
    emitted = call_at(call, np.arange(int(call.duration_s * rate_hz) + 2) / rate_hz)
    response = np.conj(scipy.fft.rfft(emitted, n_fft)[inside]) * window
    response /= np.sum(np.abs(response) ** 2 / np.where(window > 0, window, 1.0))
    return scipy.fft.rfft(signals, n_fft)[:, inside] * response, frequency_hz


def paper(words, settings: Settings, directions):
    """The image of the paper's algorithm, and its range axis: (direction, range), (range,) float64.

    Filters, correlation and low pass in the time domain, one microphone and one direction at a time.
    """
    layout = microphones(settings.array)
    rate_hz, speed_m_s = settings.signal_rate_hz, sound_speed_m_s(settings.air)
    step = settings.output_decimation
    signals = (
        signals_of(words, np.flatnonzero(layout.enabled), settings.recording) / layout.gain[layout.enabled][:, None]
    )
    padded_s = settings.call.duration_s + 40 / (settings.call.high_frequency_hz - settings.call.low_frequency_hz)
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
    """Demodulate: Butterworth low pass, every decimation-th sample, Butterworth band pass."""
    rate_hz, call = settings.signal_rate_hz, settings.call
    low_pass_hz = max(100e3 / 450e3 * rate_hz, call.high_frequency_hz)
    low_pass = scipy.signal.butter(6, low_pass_hz, fs=settings.recording.sample_rate_hz, output="sos")
    band = (call.low_frequency_hz, call.high_frequency_hz)
    band_pass = scipy.signal.butter(6, band, "bandpass", fs=rate_hz, output="sos")
    slow = scipy.signal.sosfilt(low_pass, signal)[:: settings.decimation]
    return scipy.signal.sosfilt(band_pass, slow)


def _paper_low_pass(settings):
    """The envelope's low pass, Butterworth as well, and by how many samples it is late."""
    cutoff_hz = min(settings.output_rate_hz / 2, settings.call.low_frequency_hz)
    sections = scipy.signal.butter(6, cutoff_hz, fs=settings.signal_rate_hz, output="sos")
    impulse = scipy.signal.sosfilt(sections, np.eye(1, 100_000)[0])
    return sections, round(float(np.arange(len(impulse)) @ impulse / impulse.sum()))  # delay of its centre of mass


def signals_of(words, channels, recording):
    """The signals of bits or numbers, full scale 1: (mic, sample) float64."""
    return unpack_bits(words, channels) if recording.is_pdm else words[:, channels].T / recording.full_scale


def unpack_bits(words, channels):
    """The signals of +1 and -1: (mic, sample) float64."""
    words = words.reshape(len(words), -1)
    word_bits = words.dtype.itemsize * 8
    return np.stack(
        [
            ((words[:, channel // word_bits] >> words.dtype.type(channel % word_bits)) & words.dtype.type(1)) * 2.0
            - 1.0
            for channel in channels
        ]
    )


def decimate(signals, taps, factor):
    """Every factor-th sample of the filtered signals, late by the filter's group delay."""
    filtered = [np.convolve(signal.astype(float), taps.astype(float))[: len(signal)] for signal in signals]
    return np.stack(filtered)[:, ::factor]


def delay_and_sum(signals, offsets, weights, n_ranges):
    """The complex beams: (direction, range) complex128."""
    flat = signals.reshape(-1).astype(complex)
    beams = np.zeros((len(offsets), n_ranges), dtype=complex)
    for direction, (starts, factors) in enumerate(zip(offsets, weights.astype(complex), strict=True)):
        for start, factor in zip(starts, factors, strict=True):
            beams[direction] += factor * flat[start : start + n_ranges]
    return beams


def delayed(signals, offsets, weights, n_ranges):
    """The weighted samples that a direction's beams are made of: (direction, mic, range) complex128."""
    flat = signals.reshape(-1).astype(complex)
    return flat[offsets[:, :, None] + np.arange(n_ranges)] * weights.astype(complex)[:, :, None]


def coherence_factor(signals, offsets, weights, n_ranges):
    """Delay-and-sum times the coherent by the total power: (direction, range) float64; no silence, please."""
    y = delayed(signals, offsets, weights, n_ranges)
    beams = np.abs(y.sum(axis=1))
    return beams * beams**2 / (y.shape[1] * (np.abs(y) ** 2).sum(axis=1))


def dmas(signals, offsets, weights, order, n_ranges):
    """The products of all choices of microphones, written out: (direction, range) float64; no silence, please."""
    z = delayed(signals / np.abs(signals).astype(float) ** (1 - 1 / order), offsets, weights, n_ranges)
    choices = np.array(list(itertools.combinations(range(z.shape[1]), order)))
    return np.stack([np.abs(np.prod(rows[choices], axis=1).sum(axis=0)) for rows in z])


def capon(signals, offsets, weights, n_snapshots, loading, n_ranges):
    """The weights of least variance from the whole covariance: (direction, range) float64; no silence, please."""
    image = np.empty((len(offsets), n_ranges))
    n_mics, n_snapshots = offsets.shape[1], min(n_snapshots, n_ranges)
    for direction, y in enumerate(delayed(signals, offsets, weights, n_ranges)):
        for place in range(n_ranges):
            first = min(max(place - n_snapshots // 2, 0), n_ranges - n_snapshots)
            window = y[:, first : first + n_snapshots]
            covariance = window @ window.conj().T / n_snapshots
            covariance += loading * np.trace(covariance) / n_mics * np.eye(n_mics)
            w = np.linalg.solve(covariance, np.ones(n_mics))
            image[direction, place] = np.abs((w / w.sum()).conj() @ y[:, place])
    return image


def interpolated_beams(signals, offsets, weights, places, tap_weights, rows, n_ranges):
    """Beams of nodes, and of pairs of them those of all directions: (direction, range) complex128."""
    nodes = delay_and_sum(signals, offsets, weights, n_ranges)
    return _of_pairs(nodes, places, tap_weights, rows)


def interpolated_whole_beams(tile, offsets, weights, places, tap_weights, rows, n_ranges):
    """The same from one tile of whole numbers, whose nodes keep their upper 16 bits: (direction, range) complex128.

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
    """Sums of pairs of neighbours, each put into its row: (direction, range) complex128."""
    beams = np.zeros((len(rows), nodes.shape[1]), dtype=complex)
    for pair, k in np.ndindex(tap_weights.shape[1:]):
        beams[rows] += tap_weights[:, pair, k, None].astype(float) * nodes[places[:, pair] + k]
    return beams
