"""Processing chain of RTIS Dev: filters, integer delays, rectified envelope and cleaning, as its arguments say.

Filters do not delay: the delay of an FIR filter with n taps, ``(n − 1) // 2`` samples, is removed. Sums of
microphones are not divided by their number.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy.fft
import scipy.signal
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.analysis.range_cleaning import keep_strongest
from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.interop.rtisdev import arguments

__all__ = ["Configuration", "Processor", "cleaned", "rounded"]

_DIRECTIONS_AT_A_TIME: Final = 64  # whose beams remain in the cache
_MAX_ORDER: Final = 5
_TILE: Final = 256  # samples with a common unit; a tile of 32 microphones fits into an L1 cache
_TAP_BITS: Final = 30
_MAX_TAP_SUM: Final = 65_535  # of the magnitudes of a class of envelope taps
Real = NDArray[np.float32]
Combine = Callable[[NDArray[np.int32], Real], None]
"""Function that fills beams with combinations of delayed signals."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """Arguments of `rtiscuda.preload`; None for stages that are off."""

    pdm_filter: Real  # low pass for PDM demodulation
    pre_filter: Real | None  # of the signals
    envelope_filter: Real  # low pass of rectified beams
    post_filter: Real | None  # of the beams
    matched_filter: NDArray[np.complex64] | None  # (mic, bin), as of rfft
    delays: NDArray[np.int32] | None  # (direction, mic), in samples of the signals, at least 0
    n_mics: int
    n_directions: int
    n_samples: int
    pdm_factor: int  # decimation of the PDM words to signals
    beamforming_drop: int  # samples at the end of signals without beams
    envelope_factor: int  # decimation of the rectified beams to the image
    first_range: int  # in samples of the image
    last_range: int  # not included
    clean_multipliers: tuple[float, float] | None  # 0 below these times mean and maximum of a range
    has_envelope: bool
    disabled: tuple[int, ...]
    dmas_order: int  # 1 for delay-and-sum; 2 to 5 for delay-multiply-and-sum
    coherent: bool

    def __post_init__(self) -> None:
        if self.n_signal < 1:
            raise ArgumentError(
                f"{self.n_samples} words give no signal after decimation by {self.pdm_factor}; use more words"
            )
        n_bins = self.n_signal // 2 + 1
        if self.matched_filter is not None and self.matched_filter.shape != (self.n_mics, n_bins):
            raise ArgumentError(
                f"the matched filter has shape {self.matched_filter.shape}; use ({self.n_mics}, {n_bins}) for "
                f"{self.n_mics} microphones and {self.n_samples} words"
            )
        if self.delays is not None:
            self._require_delays(self.delays)
        if not 1 <= self.dmas_order <= _MAX_ORDER:
            raise ArgumentError(f"dmasOrder is {self.dmas_order}; use 0 to {_MAX_ORDER}")
        if len(self.disabled) >= self.n_mics:
            raise ArgumentError(f"all {self.n_mics} microphones are disabled; leave one enabled")
        if self.has_envelope and not 0 <= self.first_range < self.last_range:
            raise ArgumentError(
                f"the image has ranges {self.first_range} to {self.last_range}; use a first range of at least 0, and a "
                "last range after it"
            )
        if self.has_envelope and self.last_range > (n_ranges := -(-self.n_signal // self.envelope_factor)):
            raise ArgumentError(
                f"the image ends at range {self.last_range}, but the record has {n_ranges}; use a smaller last_range"
            )

    def _require_delays(self, delays: NDArray[np.int32]) -> None:
        checks.integer("beamforming_drop", self.beamforming_drop, 0, self.n_signal - 1)
        if delays.shape != (self.n_directions, self.n_mics):
            raise ArgumentError(
                f"the delay matrix has shape {delays.shape[::-1]}; use ({self.n_mics}, {self.n_directions})"
            )
        if delays.min() < 0:
            raise ArgumentError(f"the delay matrix holds {delays.min()}; pass numbers of at least 0")
        if delays.max() > self.n_signal:
            raise ArgumentError(
                f"the delay matrix holds {delays.max()}, but signals have {self.n_signal} samples; use smaller delays"
            )

    @property
    def n_signal(self) -> int:
        """Number of samples of the signals."""
        return self.n_samples // self.pdm_factor


class Processor:
    """Thread-safe processing of measurements with one configuration."""

    def __init__(self, configuration: Configuration, *, device: str = "auto") -> None:
        self._given = configuration
        self._loaded = kernels.load(device)
        self._process_id = os.getpid()
        self._enabled = np.array([mic for mic in range(configuration.n_mics) if mic not in configuration.disabled])
        self._channels = np.arange(configuration.n_mics, dtype=np.int32)
        # With integers, all devices give the same bits, and sums of the magnitudes do not overflow.
        largest = max(float(np.abs(configuration.pdm_filter).sum()), 1e-30)
        self._scale = np.float32(largest / 2**_TAP_BITS)
        # The kernels correlate, and filters convolve.
        taps = np.rint(configuration.pdm_filter[::-1] / np.float64(self._scale)).astype(np.int32)
        self._taps = taps if len(taps) % 2 else np.append(taps, np.int32(0))
        self._envelope_taps, self._envelope_unit = rounded(configuration.envelope_filter[::-1])
        delays = configuration.delays
        self._delays = None if delays is None else np.ascontiguousarray(delays[:, self._enabled])

    @property
    def _kernels(self) -> kernels.KernelSet:
        return kernels.load("cpu") if self.has_lost_gpu else self._loaded

    @property
    def configuration(self) -> Configuration:
        """Arguments of the configuration."""
        return self._given

    @property
    def has_lost_gpu(self) -> bool:
        """True in a process that was forked from one that used a GPU, because forks cannot use it."""
        return self._loaded.device == "cuda" and self._process_id != os.getpid()

    def process(self, data: NDArray[Any], *, pdm: bool) -> Real:
        """Return the result of the last stage that is on: signals, beams or an image, (row, sample) float32."""
        return cleaned(self.uncleaned(data, pdm=pdm), self._given.clean_multipliers)

    def uncleaned(self, data: NDArray[Any], *, pdm: bool) -> Real:
        """Return the result of the last stage before cleaning, as `process` does."""
        given = self._given
        if given.delays is None and (given.has_envelope or given.post_filter is not None or given.clean_multipliers):
            if pdm:
                raise ArgumentError(
                    "the configuration has no beamforming, and therefore processes beams, not PDM words; enable "
                    "beamforming, or disable envelope, post filter and cleaning"
                )
            return self._finish(arguments.rows(data, given.n_directions))
        signals = self._demodulated(data) if pdm else arguments.rows(data, given.n_mics)
        if given.pre_filter is not None:
            signals = _filtered(signals, given.pre_filter)
        if given.matched_filter is not None:
            self._require_length(signals)
            spectra = scipy.fft.rfft(signals, axis=1, workers=-1) * given.matched_filter
            signals = scipy.fft.irfft(spectra, signals.shape[1], axis=1, workers=-1)
        if self._delays is None:
            return np.ascontiguousarray(signals, dtype=np.float32)
        self._require_length(signals)
        if given.has_envelope and given.post_filter is None:
            return self._image(signals, self._delays)
        return self._finish(self._beams(signals, self._delays))

    def _finish(self, beams: Real) -> Real:
        """Return the result of the stages after beamforming."""
        given = self._given
        if given.post_filter is not None:
            beams = _filtered(beams, given.post_filter)
        if given.has_envelope:
            first, n_samples = self._window()
            padded = np.zeros((len(beams), n_samples), np.float32)
            _copy_window(beams, first, padded)
            image = np.empty((len(beams), given.last_range - given.first_range), np.float32)
            self._envelope(padded, image)
            beams = image
        return beams

    def words(self, data: NDArray[Any]) -> NDArray[np.uint32]:
        """Return the PDM words of a measurement, which must match the configuration: (sample, 1) uint32."""
        return arguments.words(data, self._given.n_samples)

    def _demodulated(self, data: NDArray[Any]) -> Real:
        given = self._given
        words = self.words(data)
        signals = np.empty((given.n_mics, given.n_signal), np.float32)
        filtering = (self._channels, self._taps, self._scale, given.pdm_factor, 0, given.n_signal)
        self.run("demodulate_words", words, *filtering, out=signals)
        return signals

    def _beams(self, signals: Real, delays: NDArray[np.int32]) -> Real:
        """Return beams of all samples except those dropped: (direction, sample) float32."""
        given = self._given
        beams = np.empty((given.n_directions, given.n_signal - given.beamforming_drop), np.float32)
        padded = np.zeros((len(self._enabled), given.n_signal + int(delays.max(initial=0))), np.float32)
        padded[:, : given.n_signal] = signals[self._enabled]
        self._combination(padded)(delays, beams)
        return beams

    def _image(self, signals: Real, delays: NDArray[np.int32]) -> Real:
        """Return the envelope of beams, computed for the samples of the image only: (direction, range) float32."""
        given = self._given
        first, n_samples = self._window()
        n_tiles = -(-n_samples // _TILE)
        padded = np.zeros((len(self._enabled), n_tiles * _TILE + int(delays.max(initial=0))), np.float32)
        _copy_window(signals[self._enabled], first, padded)
        is_sum = given.dmas_order == 1 and not given.coherent
        combine = self._sum(*_sixteen_bits(padded, n_tiles)) if is_sum else self._combination(padded)
        image = np.empty((given.n_directions, given.last_range - given.first_range), np.float32)
        beams = np.empty((_DIRECTIONS_AT_A_TIME, n_tiles * _TILE), np.float32)
        for begin in range(0, given.n_directions, _DIRECTIONS_AT_A_TIME):
            rows = slice(begin, min(begin + _DIRECTIONS_AT_A_TIME, given.n_directions))
            some = beams[: rows.stop - rows.start]
            combine(delays[rows], some)
            # Beams outside the record do not exist, and count as 0.
            some[:, : max(0, -first)] = 0
            some[:, max(0, given.n_signal - given.beamforming_drop - first) :] = 0
            self._envelope(some, image[rows])
        return image

    def _sum(self, tiles: NDArray[np.int16], units: Real) -> Combine:
        """Return a function that sums 16-bit signals."""
        return lambda delays, out: self.run("sum_delayed_int16", tiles, units, delays, out=out)

    def _combination(self, signals: Real) -> Combine:
        """Return a function that combines signals as the configuration says."""
        order, coherent = self._given.dmas_order, int(self._given.coherent)
        roots = signals if order == 1 else np.sign(signals) * np.abs(signals) ** np.float32(1 / order)
        return lambda delays, out: self.run("combine_delayed", signals, roots, delays, order, coherent, 0, out=out)

    def _envelope(self, beams: Real, image: Real) -> None:
        """Fill ``image`` with the envelope of beams."""
        factor = self._given.envelope_factor
        self.run("rectify_and_decimate", beams, self._envelope_taps, self._envelope_unit, factor, 0, out=image)

    def run(self, name: str, *arguments: Any, out: Real) -> None:
        """Run a kernel with arrays of the host, and fill ``out``."""
        kernel_set = self._kernels
        lane = kernel_set.memory().lane()
        with kernel_set.threads(kernel_set.max_threads), lane.entered():
            sent = [lane.send(each) if isinstance(each, np.ndarray) else each for each in arguments]
            target = lane.target(out)
            getattr(kernel_set, name)(*sent, target)
            lane.fetch(target, out)
            lane.wait()

    def _window(self) -> tuple[int, int]:
        """Return the first sample of the beams that the image needs, which may be negative, and their number."""
        given = self._given
        n_taps = len(given.envelope_filter)
        first = given.first_range * given.envelope_factor - n_taps // 2
        return first, (given.last_range - given.first_range - 1) * given.envelope_factor + n_taps

    def _require_length(self, signals: Real) -> None:
        if signals.shape[1] != self._given.n_signal:
            raise ArgumentError(f"signals have {signals.shape[1]} samples; use {self._given.n_signal}")


def cleaned(image: Real, multipliers: tuple[float, float] | None) -> Real:
    """Set the amplitudes of each range to 0 that are below its limits, in place, and return the image."""
    if multipliers is not None:
        of_mean, of_max = multipliers
        keep_strongest(image, of_max=of_max, of_mean=of_mean)
    return image


def rounded(taps: NDArray[np.floating[Any]]) -> tuple[NDArray[np.int16], float]:
    """Return taps as 16-bit numbers with the largest sums that `RectifyAndDecimate` permits, and their unit."""
    exact = np.pad(taps.astype(np.float64), (0, -len(taps) % 8))
    sums = np.abs(exact).reshape(-1, 4, 2).sum(axis=(0, 2))
    unit = max(sums.max() / (_MAX_TAP_SUM - len(exact)), np.abs(exact).max() / 32_767, 1e-30)
    return np.rint(exact / unit).astype(np.int16)[: len(taps)], float(unit)


def _sixteen_bits(signals: Real, n_tiles: int) -> tuple[NDArray[np.int16], Real]:
    """Return tiles of signals as 16-bit numbers whose sum over microphones fits 16 bits, and their units."""
    # With 32 microphones, a sample has 11 bits of the largest one in its tile, and a beam an error of about -85 dB.
    windows = np.lib.stride_tricks.sliding_window_view(signals, signals.shape[1] - (n_tiles - 1) * _TILE, axis=1)
    tiles = windows[:, ::_TILE].swapaxes(0, 1)
    units = np.maximum(np.abs(tiles).max(axis=(1, 2)) / np.float32(32_767 // len(signals)), np.float32(1e-30))
    return np.rint(tiles / units[:, None, None]).astype(np.int16, order="C"), units


def _filtered(rows: Real, taps: Real) -> Real:
    """Return signals filtered without delay, of the same length."""
    long = scipy.signal.oaconvolve(rows, taps[None, :], mode="full", axes=1)
    begin = (len(taps) - 1) // 2
    return np.ascontiguousarray(long[:, begin : begin + rows.shape[1]], dtype=np.float32)


def _copy_window(rows: Real, first: int, out: Real) -> None:
    """Copy the samples from ``first`` on to ``out``; samples outside the rows stay unchanged."""
    begin, end = max(first, 0), min(first + out.shape[1], rows.shape[1])
    if begin < end:
        out[:, begin - first : end - first] = rows[:, begin:end]
