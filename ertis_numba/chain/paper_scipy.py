"""Algorithm of the 2019 paper, in plain NumPy and SciPy on one thread.

The steps of Jansen, Laurijssen, Kerstens, Daems and Steckel as a careful user of NumPy would write them: a reference
for images and for speed.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import Grid, array_weights, direction_grid, microphones, plane_delays
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Settings

__all__ = ["ScipyPaperChain", "largest_delay", "range_axis", "whole_delays"]

_ORDER = 6  # Order of all Butterworth filters. The authors' MATLAB notes state it for the first filter.
_CUTOFF = 2 / 9  # Cutoff relative to the signal rate: the authors use 100 kHz at 450 kHz.
_RINGING = 24.0  # Duration after which the band-pass filter is 100 dB down, in 1 / bandwidth or 1 / lowest frequency.
_DIRECTIONS = 16  # Number of directions in a block, which stays in the caches.


class ScipyPaperChain:
    """Signal chain of the paper, with tables computed once; implements `Chain`.

    Ranges are ``c n / (2 · signal rate)`` for every ``output_decimation``-th sample n within the range window.
    """

    def __init__(self, settings: Settings) -> None:
        layout, self._settings = microphones(settings.array), settings
        self.grid: Grid = direction_grid(settings.processing)
        self._n_samples = -(-settings.recording.n_samples // settings.decimation)
        self.range_m, self._window = range_axis(settings, self._n_samples)
        delays = whole_delays(settings, self.grid)
        self._lead = lead = largest_delay(settings, delays)
        self._starts: list[list[int]] = (delays + lead).tolist()
        self._channels = np.flatnonzero(layout.enabled).tolist()
        self._is_pdm, self._scale = settings.recording.is_pdm, np.float32(0.5 / settings.recording.full_scale)
        self._demodulate = _Demodulate(settings)
        self._low_pass = _LowPass(settings)
        weights = array_weights(settings) / (layout.gain[layout.enabled] * len(self._channels))
        self._make_matched_filter(settings, lead, weights)

    def _make_matched_filter(self, settings: Settings, lead: int, weights: NDArray[np.float64]) -> None:
        """Compute the spectrum that correlates with the call and delays by ``lead`` samples."""
        # The call passes through the same recursive filters as the signals, so that their phase cancels.
        call = _filtered_call(settings, self._demodulate)
        # The transform holds all samples that are read, the call and the leads, so nothing wraps around.
        n_needed = self._n_samples + self._low_pass.delay + len(call) + 2 * lead
        self._n_fft: int = scipy.fft.next_fast_len(n_needed, real=True)
        spectrum = scipy.fft.rfft(call, self._n_fft)
        delay = np.exp(-2j * math.pi * np.arange(len(spectrum)) * lead / self._n_fft)
        pulse = scipy.fft.irfft(np.abs(spectrum) ** 2, self._n_fft)
        peak = self._low_pass.at_peak(pulse)
        self._template = (weights[:, None] * (np.conj(spectrum) * delay / peak)).astype(np.complex64)

    def process_batch(
        self, words: Iterable[NDArray[np.unsignedinteger[Any]]], outs: Iterable[NDArray[np.float32]]
    ) -> None:
        """Compute the images of several measurements, one after the other."""
        for each, out in zip(words, outs, strict=True):
            self.process(each, out)

    def warm_up(self, words: NDArray[np.unsignedinteger[Any]]) -> None:
        """Do nothing, since this chain has no kernels to compile."""

    def new_image(self) -> NDArray[np.float32]:
        """Return an uninitialised array for an image: (direction, range) float32."""
        return np.empty((len(self.grid), len(self.range_m)), dtype=np.float32)

    def close(self) -> None:
        """Do nothing, since this chain holds no memory on a device."""

    def process(
        self,
        words: NDArray[np.unsignedinteger[Any]],
        out: NDArray[np.float32],
        *,
        threads: int | None = None,  # noqa: ARG002  This chain has one thread.
        grid: Grid | None = None,
    ) -> None:
        """Compute the image of one measurement on one thread; parameters as for `Chain.process`."""
        all_starts = self._starts
        if grid is not None:
            all_starts = (whole_delays(self._settings, grid) + self._lead).tolist()
        unpacked = _unpacked(words, self._channels) if self._is_pdm else _halved(words, self._channels, self._scale)
        signals = self._demodulate(unpacked)
        spectra = scipy.fft.rfft(signals, self._n_fft)
        spectra *= self._template
        rows = list(scipy.fft.irfft(spectra, self._n_fft, overwrite_x=True))
        beams = np.empty((_DIRECTIONS, self._n_samples + self._low_pass.delay), dtype=np.float32)
        for first in range(0, len(out), _DIRECTIONS):
            part = beams[: len(out) - first]
            for beam, starts in zip(part, all_starts[first : first + _DIRECTIONS], strict=True):
                _delay_and_sum(rows, starts, beam)
            envelopes = self._low_pass(np.abs(part, out=part))
            out[first : first + _DIRECTIONS] = envelopes[:, self._window]


def _delay_and_sum(rows: list[NDArray[np.float32]], starts: list[int], out: NDArray[np.float32]) -> None:
    """Fill ``out``, (sample,) float32, with the sum of all rows, each from its own start."""
    n = len(out)
    out[:] = rows[0][starts[0] : starts[0] + n]
    for row, start in zip(rows[1:], starts[1:], strict=True):
        np.add(out, row[start : start + n], out)


def whole_delays(settings: Settings, grid: Grid) -> NDArray[np.int64]:
    """Return the delays of directions in signal samples: (direction, mic) int64."""
    layout = microphones(settings.array)
    waves_s = plane_delays(settings, grid, sound_speed_m_s=sound_speed_m_s(settings.air))
    return np.rint((layout.delay_s[layout.enabled] + waves_s) * settings.signal_rate_hz).astype(np.int64)


def largest_delay(settings: Settings, delays: NDArray[np.int64]) -> int:
    """Return the largest magnitude of delays in signal samples, or its upper limit for level directions."""
    if not settings.processing.level_directions:
        return int(np.max(np.abs(delays)))
    layout = microphones(settings.array)
    farthest_s = np.linalg.norm(layout.enabled_positions_m, axis=1) / sound_speed_m_s(settings.air)
    return math.ceil(float(np.max(np.abs(layout.delay_s[layout.enabled]) + farthest_s)) * settings.signal_rate_hz)


def range_axis(settings: Settings, n_samples: int) -> tuple[NDArray[np.float64], slice]:
    """Return the range axis, and the slice of the outputs of the record that it covers."""
    first_m, last_m = settings.processing.range_m
    step_m = sound_speed_m_s(settings.air) / (2 * settings.output_rate_hz)
    n_outputs = -(-n_samples // settings.output_decimation)
    first = math.ceil(first_m / step_m * (1 - 1e-12))
    stop = math.floor(last_m / step_m * (1 + 1e-12)) + 1
    if stop > n_outputs:
        raise ArgumentError(
            f"processing.range_m ends at {last_m:g} m, but the record of {settings.recording.duration_s * 1e3:.4g} ms "
            f"covers {step_m * (n_outputs - 1):.4g} m; shorten processing.range_m or use a longer preset"
        )
    if first >= stop:
        raise ArgumentError(
            f"processing.range_m, {first_m:g} to {last_m:g} m, contains no multiple of the range step, {step_m:.4g} m; "
            "extend processing.range_m"
        )
    return np.arange(first, stop, dtype=np.float64) * step_m, slice(first, stop)


def _unpacked(words: NDArray[np.unsignedinteger[Any]], channels: list[int]) -> NDArray[np.float32]:
    """Return the bits as ±½: (mic, sample) float32. The gain of the matched filter compensates the factor ½.

    Shifts of whole rows of bytes take 1.5 ms; `numpy.unpackbits` and a transposition take 3.6 ms.
    """
    octets = np.ascontiguousarray(words.view(np.uint8).reshape(len(words), -1).T)
    signals = np.empty((len(channels), len(words)), dtype=np.float32)
    for signal, channel in zip(signals, channels, strict=True):
        np.subtract(octets[channel // 8] >> (channel % 8) & 1, np.float32(0.5), out=signal)
    return signals


def _halved(words: NDArray[Any], channels: list[int], scale: np.float32) -> NDArray[np.float32]:
    """Return PCM samples with a full scale of ±½, like that of bits: (mic, sample) float32."""
    return np.ascontiguousarray(words[:, channels].T) * scale


class _Demodulate:
    """Low-pass filter at the PDM rate, decimation, and band-pass filter at the signal rate."""

    # Second-order sections suffice in float32, at -111 dB from float64; one polynomial would be unstable.

    def __init__(self, settings: Settings) -> None:
        call, rate_hz = settings.call, settings.signal_rate_hz
        cutoff_hz = max(_CUTOFF * rate_hz, call.high_frequency_hz)
        band_hz = call.low_frequency_hz, call.high_frequency_hz
        butter = scipy.signal.butter
        self._low_pass = butter(_ORDER, cutoff_hz, fs=settings.recording.sample_rate_hz, output="sos")
        self._band_pass = butter(_ORDER, band_hz, "bandpass", fs=rate_hz, output="sos")
        self._decimation = settings.decimation

    def __call__(self, signals: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the filtered signals at the signal rate, (…, sample), in the precision of ``signals``."""
        low_pass, band_pass = self._low_pass.astype(signals.dtype), self._band_pass.astype(signals.dtype)
        slow = scipy.signal.sosfilt(low_pass, signals)[..., :: self._decimation]
        return np.asarray(scipy.signal.sosfilt(band_pass, slow))


def _filtered_call(settings: Settings, demodulate: _Demodulate) -> NDArray[np.float64]:
    """Return the filtered call as recorded by a microphone of amplitude ±½: (sample,) float64 at the signal rate."""
    call, rate_hz = settings.call, settings.recording.sample_rate_hz
    narrowest_hz = min(call.high_frequency_hz - call.low_frequency_hz, call.low_frequency_hz)
    length_s = call.end_s + _RINGING / narrowest_hz
    time_s = np.arange(math.ceil(length_s * rate_hz)) / rate_hz
    return np.asarray(demodulate(0.5 * call_at(call, time_s)))


class _LowPass:
    """Low-pass filter of rectified beams, decimated by ``output_decimation``; its ``delay`` in samples is compensated.

    The paper states neither order nor bandwidth; the cutoff removes the ripple at twice the carrier.
    """

    def __init__(self, settings: Settings) -> None:
        cutoff_hz = min(settings.output_rate_hz / 2, settings.call.low_frequency_hz)
        self._sections = scipy.signal.butter(_ORDER, cutoff_hz, fs=settings.signal_rate_hz, output="sos")
        nearly_0 = 1e-4
        _, response = scipy.signal.sosfreqz(self._sections, [nearly_0])
        self.delay = round(-float(np.angle(response[0])) / nearly_0)
        self._factor = settings.output_decimation

    def __call__(self, rectified: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the envelopes, (direction, output) float32, of beams that extend ``delay`` samples further."""
        filtered = scipy.signal.sosfilt(self._sections.astype(np.float32), rectified)
        return np.asarray(filtered[:, self.delay :: self._factor], dtype=np.float32)

    def at_peak(self, pulse: NDArray[np.float64]) -> float:
        """Return the envelope at the peak of a pulse that is not rectified and centred at sample 0, cyclically."""
        centred = np.abs(np.roll(pulse, len(pulse) // 2))
        return float(scipy.signal.sosfilt(self._sections, centred)[len(pulse) // 2 + self.delay])
