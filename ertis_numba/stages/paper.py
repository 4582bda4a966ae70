"""The algorithm of the 2019 paper, in plain NumPy and SciPy on one thread.

Jansen, Laurijssen, Kerstens, Daems and Steckel describe it as: Butterworth demodulation, band pass, matched
filter, delay-and-sum with delays of whole samples at the full signal rate, rectification, low pass,
subsampling. It is kept to compare with, in image and in speed, so it is written to be fast: every
choice below that is not the paper's was measured on the default record with 32 microphones.
"""

import math
from typing import Any

import numpy as np
import scipy.fft
import scipy.signal
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.errors import ArgumentError
from ertis_numba.geometry import Grid, direction_grid, far_field_delays, microphones, unit_vectors
from ertis_numba.settings import Settings
from ertis_numba.waveform import call_at

__all__ = ["PaperChain"]

_ORDER = 6  # of both Butterworth filters; the authors' MATLAB notes
_CUTOFF = 2 / 9  # of the signal rate: the authors' 100 kHz at 450 kHz
_RINGING = 24.0  # in 1 / bandwidth or 1 / lowest frequency: by then the band pass is 100 dB down
_STOP_BAND_DB = 60.0  # of the envelope's low pass
_BLOCK = 16  # outputs of the low pass per row of a matrix product; 8 and 32 are slower by 10 and 30 %


class PaperChain:
    """Words to image by the paper's algorithm, with tables made once.

    Attributes
    ----------
    grid : Grid
    range_m : (range,) float64
        ``c n / (2 · signal rate)`` for every ``output_decimation``-th sample n within the range window.

    Raises
    ------
    ArgumentError
        The range window reaches past the record or holds no sample.
    """

    def __init__(self, settings: Settings) -> None:
        layout = microphones(settings.array)
        self.grid: Grid = direction_grid(settings.processing)
        self._n_samples = -(-settings.recording.n_samples // settings.decimation)
        self.range_m, self._window = _range_axis(settings, self._n_samples)
        delays_s = layout.delay_s[layout.enabled] + far_field_delays(
            layout.enabled_positions_m,
            unit_vectors(self.grid.azimuth_rad, self.grid.elevation_rad),
            sound_speed_m_s=sound_speed_m_s(settings.air),
        )
        delays = np.rint(delays_s * settings.signal_rate_hz).astype(int)
        lead = int(np.max(np.abs(delays)))
        self._starts: list[list[int]] = (delays + lead).tolist()
        self._channels = np.flatnonzero(layout.enabled).tolist()
        self._demodulate = _Demodulate(settings)
        self._low_pass_beam = _LowPass(settings, self._n_samples)
        self._make_matched_filter(settings, lead, 1 / (layout.gain[layout.enabled] * len(self._channels)))

    def _make_matched_filter(self, settings: Settings, lead: int, weights: NDArray[np.float64]) -> None:
        """Make the spectrum that correlates with the call and delays by ``lead``.

        The call goes through the same recursive filters as the signals. So their phase, and with it
        their group delay at every frequency, drops out of the correlation, and an echo comes to lie
        at its arrival.
        """
        call = _filtered_call(settings, self._demodulate)
        # As long as record, call and both leads: nothing wraps around into what is read.
        self._n_fft: int = scipy.fft.next_fast_len(self._n_samples + len(call) + 2 * lead, real=True)
        spectrum = scipy.fft.rfft(call, self._n_fft)
        delay = np.exp(-2j * math.pi * np.arange(len(spectrum)) * lead / self._n_fft)
        pulse = scipy.fft.irfft(np.abs(spectrum) ** 2, self._n_fft)
        peak = self._low_pass_beam.at_peak(pulse)
        self._template = (weights[:, None] * (np.conj(spectrum) * delay / peak)).astype(np.complex64)

    def process(self, words: NDArray[np.unsignedinteger[Any]], out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``words``, (sample, word)."""
        signals = self._demodulate(_unpacked(words, self._channels))
        spectra = scipy.fft.rfft(signals, self._n_fft)
        spectra *= self._template
        rows = list(scipy.fft.irfft(spectra, self._n_fft, overwrite_x=True))
        padded, beam = self._low_pass_beam.new_beam()
        for direction, starts in enumerate(self._starts):
            # One direction at a time: beam and signals (2 MB) stay in the caches. Adding slices in place is
            # 20 % faster than gathering rows for one matrix product, 70 % faster than one np.sum.
            self._delay_and_sum(rows, starts, beam)
            np.abs(beam, out=beam)
            out[direction] = self._low_pass_beam(padded)[self._window]

    def _delay_and_sum(self, rows: list[NDArray[np.float32]], starts: list[int], out: NDArray[np.float32]) -> None:
        n = self._n_samples
        out[:] = rows[0][starts[0] : starts[0] + n]
        for row, start in zip(rows[1:], starts[1:], strict=True):
            np.add(out, row[start : start + n], out)


def _range_axis(settings: Settings, n_samples: int) -> tuple[NDArray[np.float64], slice]:
    """Return the range axis and which of the record's outputs it holds."""
    first_m, last_m = settings.processing.range_m
    step_m = sound_speed_m_s(settings.air) / (2 * settings.output_rate_hz)
    n_outputs = -(-n_samples // settings.output_decimation)
    first = math.ceil(first_m / step_m * (1 - 1e-12))
    stop = math.floor(last_m / step_m * (1 + 1e-12)) + 1
    if stop > n_outputs:
        raise ArgumentError(
            f"processing.range_m ends at {last_m:g} m, but the record of {settings.recording.duration_s * 1e3:.4g} ms "
            f"reaches {step_m * (n_outputs - 1):.4g} m; give a smaller range"
        )
    if first >= stop:
        raise ArgumentError(
            f"processing.range_m {first_m:g} to {last_m:g} m holds no multiple of {step_m:.4g} m; give a longer range"
        )
    return np.arange(first, stop, dtype=np.float64) * step_m, slice(first, stop)


def _unpacked(words: NDArray[np.unsignedinteger[Any]], channels: list[int]) -> NDArray[np.float32]:
    """Return the bits as (mic, sample) float32 of ±½; the matched filter's gain knows of the half.

    Shifts of whole rows of bytes: 1.5 ms where `numpy.unpackbits` and a transposition take 3.6.
    """
    octets = np.ascontiguousarray(words.view(np.uint8).reshape(len(words), -1).T)
    signals = np.empty((len(channels), len(words)), dtype=np.float32)
    for signal, channel in zip(signals, channels, strict=True):
        np.subtract(octets[channel // 8] >> (channel % 8) & 1, np.float32(0.5), out=signal)
    return signals


class _Demodulate:
    """Low pass at the PDM rate, every ``decimation``-th sample, band pass at the signal rate.

    Both filters are second-order sections, for which float32 suffices: the image differs by -111 dB from
    that of float64 and takes 20 % less time. In the form of one polynomial they would be unstable.
    """

    def __init__(self, settings: Settings) -> None:
        call, rate_hz = settings.call, settings.signal_rate_hz
        cutoff_hz = max(_CUTOFF * rate_hz, call.high_frequency_hz)
        band_hz = call.low_frequency_hz, call.high_frequency_hz
        butter = scipy.signal.butter
        self._low_pass = butter(_ORDER, cutoff_hz, fs=settings.recording.pdm_rate_hz, output="sos")
        self._band_pass = butter(_ORDER, band_hz, "bandpass", fs=rate_hz, output="sos")
        self._decimation = settings.decimation

    def __call__(self, signals: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return (…, sample) at the signal rate, in the precision of ``signals``."""
        low_pass, band_pass = self._low_pass.astype(signals.dtype), self._band_pass.astype(signals.dtype)
        slow = scipy.signal.sosfilt(low_pass, signals)[..., :: self._decimation]
        return np.asarray(scipy.signal.sosfilt(band_pass, slow))


def _filtered_call(settings: Settings, demodulate: _Demodulate) -> NDArray[np.float64]:
    """Return what a microphone of amplitude ±½ makes of the call: (sample,) float64 at the signal rate."""
    call, rate_hz = settings.call, settings.recording.pdm_rate_hz
    narrowest_hz = min(call.high_frequency_hz - call.low_frequency_hz, call.low_frequency_hz)
    length_s = call.duration_s + _RINGING / narrowest_hz
    time_s = np.arange(math.ceil(length_s * rate_hz)) / rate_hz
    return np.asarray(demodulate(0.5 * call_at(call, time_s)))


class _LowPass:
    """The low pass of a rectified beam, at every ``output_decimation``-th sample, without delay.

    The paper names no bandwidth. This low pass lets the output rate decide: -6 dB at half of it, or at
    the call's lowest frequency where that is lower, so that the ripple at twice the carrier goes and
    as much of the range resolution stays as the output can hold. It is a symmetric filter (sinc under a
    Kaiser window), evaluated at the outputs alone and centred, so it delays nothing.

    As a matrix product of blocks with a band of taps it takes 14 µs per beam, `scipy.signal.upfirdn` with
    the same taps 41 µs, and a recursive filter of order 6, run at the full rate, 88 µs.
    """

    def __init__(self, settings: Settings, n_samples: int) -> None:
        rate_hz = settings.signal_rate_hz
        cutoff_hz = min(settings.output_rate_hz / 2, settings.call.low_frequency_hz)
        n_taps, beta = scipy.signal.kaiserord(_STOP_BAND_DB, cutoff_hz / (rate_hz / 2))
        self._taps = scipy.signal.firwin(n_taps | 1, cutoff_hz, window=("kaiser", beta), fs=rate_hz)
        self._half = len(self._taps) // 2
        self._factor = settings.output_decimation
        self._n_samples = n_samples
        # Output i of a block weighs the samples from i · factor on: those of its own block and of the next.
        in_block = max(_BLOCK, -(-len(self._taps) // self._factor))
        band = np.zeros((2 * in_block * self._factor, in_block), dtype=np.float32)
        for i in range(in_block):
            band[i * self._factor :][: len(self._taps), i] = self._taps
        self._this, self._next = np.split(band, 2)
        self._n_next = len(self._taps) - self._factor  # rows of the next block that are not 0
        self._n_blocks = -(-(self._half + n_samples) // len(self._this))

    def new_beam(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return zeros for the filter to run into, and within them, as a view, the samples of a beam."""
        padded = np.zeros((self._n_blocks + 1) * len(self._this), dtype=np.float32)
        return padded, padded[self._half : self._half + self._n_samples]

    def __call__(self, padded: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the envelope of a rectified beam: (output,) float32."""
        blocks = padded.reshape(self._n_blocks + 1, -1)
        envelope = blocks[:-1] @ self._this
        envelope += blocks[1:, : self._n_next] @ self._next[: self._n_next]
        return envelope.reshape(-1)

    def at_peak(self, pulse: NDArray[np.float64]) -> float:
        """Return the envelope at the peak of a pulse, not rectified, that is centred at sample 0 of a circle."""
        around = np.arange(-self._half, self._half + 1)
        return float(self._taps @ np.abs(pulse[around]))
