"""Exact image in float64, without the approximations of the images that are compared with it.

The samples of the record pass through one transform at the record's own sample rate, long enough to prevent
wrap-around. Each bin is multiplied by the matched filter of the call at that rate, and by the phase of each
microphone's exact delay. There is no decimation, no interpolation, no focal zone, no plan, and no rounding except that
of float64.
"""

import math
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import array_weights, delay_matrix, far_field_delays, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_samples, matched_band_hz
from ertis_numba.pipeline.verification._beamformers import combine
from ertis_numba.settings import Settings

__all__ = ["ExactImage"]

_CACHED = 65_536  # Complex numbers in an array of which a processor's cache holds several.
_RINGING = 100.0  # The ringing of a raised cosine of width w is below -160 dB after 100 / w.


class ExactImage:
    """The exact counterpart of an image of a measurement, computed by direction from its axes and settings."""

    def __init__(self, image: Energyscape, measurement: Measurement) -> None:
        settings = self._settings = image.settings
        if settings.processing.is_cleaned:
            raise ArgumentError(
                "image is cleaned by processing.clean_within_db or clean_above_mean_db, but the exact image is not; "
                "pass the image of Pipeline.process(measurement, clean=False)"
            )
        layout = microphones(settings.array)
        self._positions_m = layout.enabled_positions_m
        self._directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
        self._given_s = delay_matrix(settings, n_directions=len(self._directions))
        self._range_m = image.range_m
        self._speed_m_s = sound_speed_m_s(settings.air)
        self._step = settings.processing.range_decimation
        self._n_fft = _transform_length(settings)
        self._bins, response = _matched_response(settings, self._n_fft)
        self._wave_rad_s = 2 * math.pi * self._bins * settings.recording.sample_rate_hz / self._n_fft
        words = sample_format(settings).validated(measurement.data)
        spectra = [
            scipy.fft.rfft(_signal(words, channel, settings), self._n_fft)[self._bins] * response
            for channel in np.flatnonzero(layout.enabled).tolist()
        ]
        calibration = np.exp(1j * self._wave_rad_s * layout.delay_s[layout.enabled][:, None])
        weighted = np.stack(spectra) * array_weights(settings)[:, None]
        self._spectra = weighted * calibration / layout.gain[layout.enabled][:, None]

    @property
    def operations_per_direction(self) -> int:
        """Estimated number of complex multiplications per direction."""
        n_mics, n_bins = self._spectra.shape
        if self._settings.processing.wavefront == "spherical":
            count = n_mics * n_bins * len(self._range_m)
        else:
            n_outputs = self._n_fft // self._step
            count = n_mics * (n_bins + round(n_outputs * math.log2(n_outputs)))
        if self._settings.processing.beamformer == "capon":
            count += len(self._range_m) * n_mics**2 * (n_mics // 3 + self._settings.processing.snapshots)
        return int(count)

    def amplitudes(self, direction: int, ranges: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the exact amplitudes of some ranges, given by their indices, of one direction: (range,)."""
        processing = self._settings.processing
        if processing.wavefront == "spherical":
            return combine(self._spherical(direction, self._range_m[ranges]), processing)
        return combine(self._plane(direction), processing)[ranges]  # Capon needs the neighbours of a range, too.

    def _plane(self, direction: int) -> NDArray[np.complex128]:
        """Return signals delayed for plane waves, (mic, range), by one inverse transform of the folded bins."""
        if self._given_s is not None:
            delay_s = self._given_s[direction]
        else:
            towards = self._directions[direction : direction + 1]
            delay_s = far_field_delays(self._positions_m, towards, sound_speed_m_s=self._speed_m_s)[0]
        at_s = delay_s + 2 * self._range_m[0] / self._speed_m_s
        turned = self._spectra * _powers(at_s, self._wave_rad_s)
        n_outputs = self._n_fft // self._step
        folded: NDArray[np.complex128] = np.zeros((len(turned), n_outputs), dtype=np.complex128)
        for first in range(0, len(self._bins), n_outputs):
            part = turned[:, first : first + n_outputs]
            folded[:, : part.shape[1]] += part
        # Bin 0 of the transform is the first bin of the band. Its phase advances by this factor from range to range.
        carrier = np.exp(2j * math.pi * (self._bins[0] * np.arange(len(self._range_m)) % n_outputs) / n_outputs)
        return np.asarray(
            scipy.fft.ifft(folded, axis=1, norm="forward")[:, : len(self._range_m)] * carrier, np.complex128
        )

    def _spherical(self, direction: int, range_m: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the signals delayed for a point at each range: (mic, range) complex128."""
        points_m = range_m[:, None] * self._directions[direction]
        paths_m = np.linalg.norm(points_m - self._positions_m[:, None], axis=2) + range_m  # (mic, range)
        at_s = paths_m / self._speed_m_s
        # Σ_k Y_k exp(jω_k t) with k = a·n + b: a matrix product sums over a, then a second sum runs over b. Both are
        # exact.
        n = self._tabled.shape[2]
        spacing_rad_s = self._wave_rad_s[1] - self._wave_rad_s[0] if len(self._bins) > 1 else 0.0
        out: NDArray[np.complex128] = np.exp(1j * self._wave_rad_s[0] * at_s)
        n_at_once = max(1, _CACHED // (len(out) * n))
        for first in range(0, len(range_m), n_at_once):
            part = np.s_[:, first : first + n_at_once]
            coarse = _steps(at_s[part], n * spacing_rad_s, n)
            fine = _steps(at_s[part], spacing_rad_s, n)
            out[part] *= np.einsum("mbt,mbt->mt", self._tabled @ coarse, fine)
        return out

    @cached_property
    def _tabled(self) -> NDArray[np.complex128]:
        """Spectra as square tables, padded with zeros: (mic, b, a) complex128."""
        n_mics, n_bins = self._spectra.shape
        n = math.ceil(math.sqrt(n_bins))
        padded: NDArray[np.complex128] = np.zeros((n_mics, n * n), dtype=np.complex128)
        padded[:, :n_bins] = self._spectra
        return np.ascontiguousarray(padded.reshape(n_mics, n, n).transpose(0, 2, 1))


def _transform_length(settings: Settings) -> int:
    """Return a transform length for record, call and ringing; it is a multiple of the samples per range."""
    call, (low_hz, high_hz) = settings.call, matched_band_hz(settings)
    edge_hz = min(call.low_frequency_hz - low_hz, high_hz - call.high_frequency_hz)
    rate_hz, step = settings.recording.sample_rate_hz, settings.processing.range_decimation
    processing = settings.processing
    own_s = (len(processing.pre_filter) + len(processing.post_filter)) / call.high_frequency_hz
    needed = settings.recording.n_samples + math.ceil((call.end_s + _RINGING / edge_hz + own_s) * rate_hz)
    return step * int(scipy.fft.next_fast_len(-(-needed // step)))


def _matched_response(settings: Settings, n_fft: int) -> tuple[NDArray[np.int64], NDArray[np.complex128]]:
    """Return the bins of the band and the matched filter there, scaled to a peak envelope of 1 for the call."""
    call, (low_hz, high_hz) = settings.call, matched_band_hz(settings)
    rate_hz = settings.recording.sample_rate_hz
    frequency_hz = np.arange(n_fft // 2 + 1) * rate_hz / n_fft
    rising = np.clip((frequency_hz - low_hz) / (call.low_frequency_hz - low_hz), 0.0, 1.0)
    falling = np.clip((high_hz - frequency_hz) / (high_hz - call.high_frequency_hz), 0.0, 1.0)
    window = (1 - np.cos(math.pi * rising)) / 2 * (1 - np.cos(math.pi * falling)) / 2
    bins = np.flatnonzero(window)
    emitted = scipy.fft.rfft(call_samples(call, rate_hz=rate_hz), n_fft)[bins]
    response = np.conj(emitted) * window[bins]
    own = _own_response(settings, frequency_hz[bins])
    return bins, response * own / np.sum(np.abs(emitted * response * own))


def _own_response(settings: Settings, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return the gain of own filters without their mean group delay: (bin,) complex128."""
    processing = settings.processing
    rate_hz = processing.filter_rate_hz or settings.signal_rate_hz
    gain: NDArray[np.complex128] = np.ones(len(frequency_hz), dtype=np.complex128)
    for taps in (processing.pre_filter, processing.post_filter):
        if taps:
            gain *= scipy.signal.freqz(taps, worN=frequency_hz, fs=rate_hz)[1]
            _, passed = scipy.signal.freqz(taps, worN=8 * len(taps), whole=True)
            _, delay = scipy.signal.freqz(np.arange(len(taps)) * taps, worN=8 * len(taps), whole=True)
            samples = np.sum((delay * passed.conj()).real) / np.sum(np.abs(passed) ** 2)
            gain *= np.exp(2j * math.pi * frequency_hz * samples / rate_hz)
    return gain


def _signal(words: NDArray[Any], channel: int, settings: Settings) -> NDArray[np.float64]:
    """Return the signal of one channel, relative to full scale: (sample,) float64."""
    if not settings.recording.is_pdm:
        return np.asarray(words[:, channel].astype(np.float64) / settings.recording.full_scale)
    place, bit = divmod(channel, 8 * words.dtype.itemsize)
    return np.asarray(((words[:, place] >> bit) & 1) * 2.0 - 1.0)


def _powers(time_s: NDArray[np.float64], wave_rad_s: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return ``exp(jωt)`` for evenly spaced ω: (time, wave) complex128."""
    n_waves = len(wave_rad_s)
    n = math.ceil(math.sqrt(n_waves))
    spacing_rad_s = wave_rad_s[1] - wave_rad_s[0] if n_waves > 1 else 0.0
    coarse = np.exp(1j * np.multiply.outer(time_s, wave_rad_s[::n]))
    fine = np.exp(1j * np.multiply.outer(time_s, spacing_rad_s * np.arange(n)))
    return np.asarray((coarse[:, :, None] * fine[:, None, :]).reshape(len(time_s), -1)[:, :n_waves])


def _steps(time_s: NDArray[np.float64], spacing_rad_s: float, count: int) -> NDArray[np.complex128]:
    """Return ``exp(jk·spacing·t)`` for k from 0 to ``count - 1``: (mic, count, time) complex128."""
    turns: NDArray[np.complex128] = np.empty((len(time_s), count, time_s.shape[1]), dtype=np.complex128)
    turns[:, 0] = 1.0
    done = 1
    while done < count:  # Each turn by ``done`` steps doubles the number of known powers.
        more = min(done, count - done)
        turns[:, done : done + more] = turns[:, :more] * np.exp(1j * done * spacing_rad_s * time_s)[:, None]
        done += more
    return turns
