"""Matched filter: pulse compression of signals to analytic signals."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.geometry.waveform import filter_response, matched_filter_spectrum
from ertis_numba.kernels import KernelSet, Memory
from ertis_numba.kernels.fft import Transforms
from ertis_numba.settings import Settings

__all__ = ["Gain", "MatchedFilter", "flat_spectrum"]

Gain = Callable[[NDArray[np.float64]], NDArray[np.complex128]]
"""Function of frequencies in hertz, (bin,), that returns gains, (mic, bin) or (1, bin)."""

Spectra = NDArray[np.complex64] | None


class MatchedFilter:
    """Matched filter that returns analytic signals, (mic, phase, sample), at the output rate in several phases.

    The samples of phase p lie ``p / n_phases`` of a step after those of phase 0. The filter divides by the gain of the
    decimation filter ``taps``, and applies ``gain``, a function of frequencies (bin,) in Hz.
    """

    def __init__(
        self,
        settings: Settings,
        window: TimeWindow,
        kernels: KernelSet,
        memory: Memory,
        *,
        taps: NDArray[np.int16] | NDArray[np.int32],
        n_mics: int,
        gain: Gain,
    ) -> None:
        rate_hz = settings.signal_rate_hz
        self.first_bin, self.frequency_hz, flat = flat_spectrum(settings, taps, n_fft=window.n_fft)
        n_phases = settings.accuracy.oversampling or 1
        phase_s = np.arange(n_phases)[:, None] / (n_phases * settings.output_rate_hz)
        lag_s = window.start_s - window.first_sample / rate_hz + phase_s
        # Neither transform divides by its length. This division by the forward length supplies the missing factor.
        shifted = flat / window.n_fft * np.exp(2j * math.pi * self.frequency_hz * lag_s)
        self._responses = memory.table((gain(self.frequency_hz)[:, None, :] * shifted).astype(np.complex64))
        self._kernel = kernels.multiply_and_fold
        self.shape = (n_mics, n_phases, window.n_outputs)

    def __call__(
        self, transforms: Transforms, out: NDArray[np.complex64], *, threads: int, spectra: Spectra = None
    ) -> None:
        """Fill ``out``, (mic, phase, sample) complex64, with ``transforms`` that were planned for this array.

        ``spectra`` are those of the signals, from ``transforms``, if they were computed before.
        """
        self.fill_spectra(transforms, out, threads=threads, spectra=spectra)
        transforms.inverse(threads=threads)

    def fill_spectra(
        self, transforms: Transforms, out: NDArray[np.complex64], *, threads: int, spectra: Spectra = None
    ) -> None:
        """Fill ``out``, (mic, phase, k) complex64, with the filtered spectra, as `MultiplyAndFold` folds them."""
        spectra = transforms.forward(threads=threads) if spectra is None else spectra
        self._kernel(spectra, self._responses, self.first_bin, out)


def flat_spectrum(
    settings: Settings, taps: NDArray[np.int16] | NDArray[np.int32], *, n_fft: int
) -> tuple[int, NDArray[np.float64], NDArray[np.complex128]]:
    """Return the first bin, frequencies (bin,) in Hz, and the matched filter (bin,) divided by decimation's gain."""
    matched = matched_filter_spectrum(settings, n_fft=n_fft)
    frequency_hz = (matched.first_bin + np.arange(len(matched.values))) * settings.signal_rate_hz / n_fft
    decimated = filter_response(taps / taps.sum(dtype=np.int64), frequency_hz / settings.recording.sample_rate_hz)
    return matched.first_bin, frequency_hz, matched.values / decimated
