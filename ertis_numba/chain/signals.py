"""Signals of a measurement, before and after the matched filter, for plots and export."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.chain.demodulate import demodulation
from ertis_numba.chain.plan_elements import chain_taps
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import microphones
from ertis_numba.geometry.waveform import matched_filter_spectrum, matched_guard_s
from ertis_numba.settings import Settings

__all__ = ["matched", "signals_of"]


def signals_of(
    measurement: Measurement,
    *,
    settings: Settings | None = None,
    window: TimeWindow | None = None,
    max_samples: int | None = None,
) -> NDArray[np.float32]:
    """Return decimated signals (mic, sample) of the enabled microphones, divided by gains, with a full scale of 1."""
    # Sample n lies at the recorded sample n times the decimation. Calibrated delays are not compensated.
    settings = settings or measurement.settings
    layout = microphones(settings.array)
    recorded = settings.recording.n_samples
    count = -(-min(recorded, max_samples or recorded) // settings.decimation)
    window = window or TimeWindow.from_start(count, n_fft=count)
    plain = kernels.load("numpy")  # These need no compilation, and all devices return the same signals of PDM.
    memory = plain.memory()
    demodulate = demodulation(settings, layout, window, plain, memory, taps=chain_taps(settings))
    out: NDArray[np.float32] = memory.zeros(demodulate.shape, np.float32)
    demodulate(sample_format(settings).validated(measurement.data), demodulate.new_room(), out)
    out /= layout.gain[layout.enabled, None].astype(np.float32)
    return out


def matched(signals: NDArray[np.float32], settings: Settings) -> NDArray[np.complex64]:
    """Return signals from sample 0 on after the call's matched filter, analytic: (mic, sample)."""
    # An echo of amplitude 1 that starts at sample n has its peak there, with an envelope of 1.
    count = signals.shape[1]
    # The filter rings for the call's duration and a guard on either side; the padding keeps its ends apart.
    guard_s = settings.call.end_s + 2 * matched_guard_s(settings)
    n_fft = count + math.ceil(guard_s * settings.signal_rate_hz) + 1
    spectrum = matched_filter_spectrum(settings, n_fft=n_fft)
    occupied = slice(spectrum.first_bin, spectrum.first_bin + len(spectrum.values))
    spectra = np.zeros((len(signals), n_fft), dtype=np.complex128)
    spectra[:, occupied] = np.fft.rfft(signals, n_fft, axis=1)[:, occupied] * spectrum.values
    return np.fft.ifft(spectra, axis=1)[:, :count].astype(np.complex64)
