"""Signals of the microphones, before and after the matched filter."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.chain.matched_filter import MatchedFilter
from ertis_numba.chain.plan_elements import chain_taps
from ertis_numba.chain.signals import signals_of
from ertis_numba.chain.time_window import time_window
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.kernels import fft
from ertis_numba.settings import Accuracy, Processing, Settings

__all__ = ["MicrophoneTraces", "echoes", "signals"]

_MAX_SAMPLES = 2**19  # of the record, 0.1 s of an eRTIS: what a picture can show


@dataclass(frozen=True, slots=True, eq=False)
class MicrophoneTraces:
    """Values of each microphone over time or range."""

    values: NDArray[np.float32]  # (mic, place), full scale 1
    axis: NDArray[np.float64]  # (place,) seconds from the start of the emission, or metres
    channels: NDArray[np.int64]  # (mic,) channel of each microphone


def signals(measurement: Measurement) -> MicrophoneTraces:
    """Return the signals of the first 524,288 samples at most."""
    settings = measurement.settings
    values = signals_of(measurement, max_samples=_MAX_SAMPLES)
    return MicrophoneTraces(values, np.arange(values.shape[1]) / settings.signal_rate_hz, _channels(settings))


def echoes(measurement: Measurement) -> MicrophoneTraces:
    """Return envelopes of echoes at all samples of the range window, without calibrated gains and delays."""
    given = measurement.settings
    step = given.decimation
    settings = given.replace(
        processing=Processing(range_m=given.processing.range_m, range_decimation=step, decimation=step),
        accuracy=Accuracy(oversampling=1),
    )
    layout = microphones(settings.array)
    own_s = layout.delay_s[layout.enabled]
    taps = chain_taps(settings)
    window = time_window(settings, largest_delay_s=float(np.abs(own_s).max()), n_taps=len(taps))
    heard = signals_of(measurement, settings=settings, window=window)
    plain = kernels.load("numpy")
    memory = plain.memory()
    matched = MatchedFilter(
        settings,
        window,
        plain,
        memory,
        taps=taps,
        n_mics=len(heard),
        gain=lambda frequency_hz: np.exp(2j * np.pi * own_s[:, None] * frequency_hz),
    )
    analytic = memory.zeros(matched.shape, np.complex64)
    matched(fft.plan(plain.transforms, heard, analytic, zeros=memory.zeros, stream=None), analytic, threads=1)
    envelope = np.abs(analytic[:, 0, window.lead : window.lead + len(window.range_m)])
    return MicrophoneTraces(envelope, window.range_m, _channels(settings))


def _channels(settings: Settings) -> NDArray[np.int64]:
    return np.flatnonzero(microphones(settings.array).enabled)
