"""Textbook delay-and-sum as tables that every array library can use."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.time_window import time_window
from ertis_numba.geometry import array_weights, direction_grid, far_field_delays, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import decimation_taps, filter_response, matched_band_hz, matched_filter_spectrum
from ertis_numba.settings import Settings

__all__ = ["N_PHASES", "Implementation", "Problem"]

N_PHASES: Final = 10
"""Samples per range. It is the smallest number with which delays of whole samples keep the default budget, -35 dB."""

_STOPBAND_ATTENUATION_DB: Final = 60.0

Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Implementation:
    """Implementation of the signal chain for one kind of measurement.

    Attributes
    ----------
    process : callable
        Returns the image of words: (direction, range) float32.
    prepared : callable or None
        Returns a function that repeats delay-and-sum with envelope on the signals of the given words; None if
        delay-and-sum is no separate step.
    threads : int
    """

    process: Callable[[NDArray[Any]], Image]
    prepared: Callable[[NDArray[Any]], Callable[[], Image]] | None
    threads: int

    @classmethod
    def of(cls, signals: Callable[[NDArray[Any]], Any], delay_and_sum: Callable[[Any], Image], *, threads: int) -> Self:
        """Return an implementation of two steps: analytic signals of words, and the image of signals."""

        def prepared(words: NDArray[Any]) -> Callable[[], Image]:
            heard = signals(words)
            return lambda: delay_and_sum(heard)

        return cls(lambda words: delay_and_sum(signals(words)), prepared, threads)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Tables from words to image.

    The words are unpacked, low-pass filtered, decimated, and correlated with the call in the frequency domain. The
    inverse transform returns analytic signals with `N_PHASES` samples per range. Delay-and-sum reads each microphone
    from its nearest sample on, and corrects the phase of the carrier for the rest of the delay.

    Attributes
    ----------
    channels : (mic,) int32
        Bits of a word.
    words : slice
        Words that the image needs.
    taps : (decimation, step) float32
        Low-pass filter with a gain of 2: sample n is Σ ``bits[(n + step) · decimation + i] · taps[i, step] − 1``, with
        bits of 0 and 1.
    n_signals : int
        Number of samples after the decimation.
    n_fft : int
        Length of the forward transform.
    bins : slice
        Bins of the call's band.
    response : (mic, b) complex64
        Matched filter for these bins, with the calibration of the microphones.
    shape : (mic, phase, output)
        Shape of the analytic signals. Sample k lies in phase ``k % phases``.
    starts : (direction, mic) int32
        First sample of each beam in the flattened signals.
    weights : (direction, mic) complex64
    n_ranges : int
    rate_hz : float
        Rate of the analytic signals.
    units : (direction, axis) float64
        Unit vectors of the directions.
    positions_m : (mic, axis) float64
    sound_speed_m_s : float
    lead_m : float
        Path from the first sample to that of the first range at the origin.
    """

    channels: NDArray[np.int32]
    words: slice
    taps: NDArray[np.float32]
    n_signals: int
    n_fft: int
    bins: slice
    response: NDArray[np.complex64]
    shape: tuple[int, int, int]
    starts: NDArray[np.int32]
    weights: NDArray[np.complex64]
    n_ranges: int
    rate_hz: float
    units: NDArray[np.float64]
    positions_m: NDArray[np.float64]
    sound_speed_m_s: float
    lead_m: float

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """Return the tables for settings with at most 64 PDM microphones and plane waves, within the record."""
        layout, speed_m_s = microphones(settings.array), sound_speed_m_s(settings.air)
        grid = direction_grid(settings.processing)
        positions_m, units = layout.enabled_positions_m, unit_vectors(grid.azimuth_rad, grid.elevation_rad)
        delays_s = far_field_delays(positions_m, units, sound_speed_m_s=speed_m_s)
        rate_hz, factor = settings.recording.sample_rate_hz, settings.decimation
        taps = decimation_taps(
            sample_rate_hz=rate_hz,
            decimation=factor,
            pass_hz=matched_band_hz(settings)[1],
            stopband_attenuation_db=_STOPBAND_ATTENUATION_DB,
        )
        own_s = layout.delay_s[layout.enabled]
        largest_s = float(np.abs(delays_s).max() + np.abs(own_s).max())
        window = time_window(settings, largest_delay_s=largest_s, n_taps=len(taps))
        n_steps = -(-len(taps) // factor)
        padded = np.zeros(n_steps * factor, np.float32)
        padded[: len(taps)] = 2 * taps
        first = window.first_sample * factor - len(taps) // 2
        matched = matched_filter_spectrum(settings, n_fft=window.n_fft)
        last = matched.first_bin + len(matched.values)
        frequency_hz = np.arange(matched.first_bin, last) * settings.signal_rate_hz / window.n_fft
        ahead_s = window.start_s - window.first_sample / settings.signal_rate_hz + own_s
        gain = matched.values / filter_response(taps, frequency_hz / rate_hz) / window.n_fft
        amplitudes = array_weights(settings) / layout.gain[layout.enabled]
        response = amplitudes[:, None] * gain * np.exp(2j * np.pi * ahead_s[:, None] * frequency_hz)
        from_first_s = window.lead / settings.output_rate_hz + delays_s
        fine_hz = settings.output_rate_hz * N_PHASES
        whole = np.rint(from_first_s * fine_hz).astype(np.int32)
        mic = np.arange(len(own_s), dtype=np.int32)
        rest_s = from_first_s - whole / fine_hz
        return cls(
            channels=np.flatnonzero(layout.enabled).astype(np.int32),
            words=slice(first, first + (window.n_samples + n_steps - 1) * factor),
            taps=np.ascontiguousarray(padded.reshape(n_steps, factor).T),
            n_signals=window.n_samples,
            n_fft=window.n_fft,
            bins=slice(matched.first_bin, last),
            response=response.astype(np.complex64),
            shape=(len(mic), N_PHASES, window.n_outputs),
            starts=(mic * N_PHASES + whole % N_PHASES) * np.int32(window.n_outputs) + whole // N_PHASES,
            weights=(np.exp(2j * np.pi * matched.centre_hz * rest_s) / len(mic)).astype(np.complex64),
            n_ranges=len(window.range_m),
            rate_hz=fine_hz,
            units=units,
            positions_m=positions_m,
            sound_speed_m_s=speed_m_s,
            lead_m=window.lead / settings.output_rate_hz * speed_m_s,
        )
