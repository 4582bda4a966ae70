"""The signals of a measurement by themselves, for whoever wants to look at them or take them elsewhere."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.sample_format import sample_format
from ertis_numba.settings import Settings
from ertis_numba.stages.demodulate import demodulation
from ertis_numba.stages.plan_elements import chain_taps
from ertis_numba.stages.window import TimeWindow
from ertis_numba.waveform import matched_filter_spectrum

__all__ = ["matched_signals_of", "signals_of"]


def signals_of(
    measurement: Measurement,
    *,
    settings: Settings | None = None,
    window: TimeWindow | None = None,
    max_samples: int | None = None,
) -> NDArray[np.float32]:
    """Return the signals of the enabled microphones, low-passed and decimated: (mic, sample) float32, full scale 1.

    Sample n is the one at word n times the decimation. They are divided by the calibrated gains;
    calibrated delays are left in.

    Parameters
    ----------
    measurement : Measurement
    settings : Settings, optional
        Whose decimation and stop band count; the measurement's own by default.
    window : TimeWindow, optional
        Which of the samples; all by default.
    max_samples : int, optional
        Of the words that are looked at where no window is given.

    Raises
    ------
    DataError
        The words are not those of the settings.
    """
    settings = settings or measurement.settings
    layout = microphones(settings.array)
    recorded = settings.recording.n_samples
    count = -(-min(recorded, max_samples or recorded) // settings.decimation)
    window = window or TimeWindow(
        range_m=np.zeros(0), first_sample=0, n_samples=count, n_fft=count, n_outputs=0, lead=0, start_s=0.0
    )
    plain = kernels.load("numpy")  # has nothing to compile; all devices give the same bits of PDM
    memory = plain.memory()
    demodulate = demodulation(settings, layout, window, plain, memory, taps=chain_taps(settings))
    out: NDArray[np.float32] = memory.zeros(demodulate.shape, np.float32)
    demodulate(sample_format(settings).validated(measurement.data), demodulate.new_room(), out)
    out /= layout.gain[layout.enabled, None].astype(np.float32)
    return out


def matched_signals_of(measurement: Measurement, *, settings: Settings | None = None) -> NDArray[np.complex64]:
    """Return the signals of `signals_of` after the call's matched filter: (mic, sample) complex64, analytic.

    An echo of amplitude 1 that begins at sample n has its peak, an envelope of 1, at sample n.

    Parameters
    ----------
    measurement : Measurement
    settings : Settings, optional
        The measurement's own by default.

    Raises
    ------
    DataError
        The words are not those of the settings.
    """
    settings = settings or measurement.settings
    signals = signals_of(measurement, settings=settings)
    count = signals.shape[1]
    n_fft = count + math.ceil(settings.call.duration_s * settings.signal_rate_hz) + 1
    matched = matched_filter_spectrum(settings, n_fft=n_fft)
    occupied = slice(matched.first_bin, matched.first_bin + len(matched.values))
    spectra = np.zeros((len(signals), n_fft), dtype=np.complex128)
    spectra[:, occupied] = np.fft.rfft(signals, n_fft, axis=1)[:, occupied] * matched.values
    return np.fft.ifft(spectra, axis=1)[:, :count].astype(np.complex64)
