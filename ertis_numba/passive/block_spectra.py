"""Spectra of blocks of a measurement: demodulation, window, and Fourier transform."""

import math
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.sample_faults import dropouts
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Measurement
from ertis_numba.kernels import KernelSet, fft
from ertis_numba.passive.block_lengths import BINS_OF_A_BAND, block_length, spacing_of
from ertis_numba.passive.heard_signals import HeardSignals, heard_bands
from ertis_numba.settings import Settings

__all__ = ["BlockSpectra", "Products"]

_SPREAD: Final = 8  # Samples by which the filter of a decimation spreads.
_CHANNELS: Final = 16  # Largest number of channels whose frequencies are measured.


class Products(NamedTuple):
    """Sums over the blocks of a measurement."""

    matrix: NDArray[np.complex64]  # (bin, mic, mic) products of the spectra
    slopes: NDArray[np.complex64]  # (bin, n, n) products under the slope of the window with those under the window
    squares: NDArray[np.float64]  # (bin,) mean power under the slope of the window
    n_blocks: int


class BlockSpectra:
    """Sums of the products of spectra over the blocks of measurements."""

    # Bin 1 has the frequency `spacing_hz`. Frequencies within bins are measured at the microphones `channels`.

    def __init__(self, settings: Settings, kernels: KernelSet, *, threads: int) -> None:
        self._kernels, self._threads = kernels, threads
        self.bands_hz = heard_bands(settings)
        self._read = HeardSignals(settings, device=kernels.device, threads=threads)
        rate_hz, (n_mics, n_samples) = self._read.rate_hz, self._read.shape
        self.spacing_hz, self._n_block = _spacing(settings, self.bands_hz, rate_hz)
        if self._n_block > n_samples:
            self._read.close()
            raise ArgumentError(_too_narrow(settings, self._n_block, n_samples, rate_hz))
        first = max(1, math.ceil(self.bands_hz.min() / self.spacing_hz - 0.5))
        stop = max(first + 2, math.floor(self.bands_hz.max() / self.spacing_hz + 0.5) + 1)
        self.bins = np.arange(first, stop, dtype=np.uint32)
        self.frequency_hz = self.bins * self.spacing_hz
        self._memory = kernels.memory()
        self._lane = self._memory.lane()
        self._heard = np.zeros((n_mics, n_samples), np.float32)
        self._window = scipy.signal.get_window("hann", self._n_block).astype(np.float32)
        turns = np.arange(self._n_block) / self._n_block
        self._slope = (np.sin(2 * np.pi * turns) / 2 * self.spacing_hz).astype(np.float32)
        self.channels = np.unique(np.linspace(0, n_mics - 1, min(_CHANNELS, n_mics)).astype(int))
        self._scale = np.float32(2 / (self._n_block * float((self._window.astype(np.float64) ** 2).sum())))
        self.masked_s = self._read.n_masked / rate_hz
        self._transforms: dict[int, tuple[NDArray[np.float32], fft.Transforms]] = {}
        self._sums = self._memory.zeros((len(self.bins), n_mics, n_mics), np.complex64)

    def products(self, measurement: Measurement, *, masked: bool) -> Products:
        """Return the sums over the blocks without dropouts; if masked, without those of the call."""
        heard = self._read(measurement, out=self._heard)
        hop = self._n_block // 2
        first = self._read.n_masked if masked else 0
        n_blocks = (heard.shape[1] - first - self._n_block) // hop + 1
        if n_blocks < 1:
            raise DataError(
                f"a measurement has no block of {self._n_block} samples after its call; use wider bands, a larger "
                "passive.resolution_hz, or passive measurements"
            )
        kept = self._intact(measurement, first, n_blocks)
        n_blocks, starts = len(kept), kept * hop
        if not n_blocks:
            raise DataError(
                f"a measurement has no block of {self._n_block} samples without a dropout; check the link to the "
                "sensor, and record again"
            )
        blocks, transforms = self._planned(n_blocks)
        with self._kernels.threads(self._threads), self._lane.entered():
            pieces = np.lib.stride_tricks.sliding_window_view(heard[:, first:], self._n_block, axis=1)
            np.multiply(pieces[:, starts], self._window, out=blocks)
            self._lane.send(blocks.reshape(-1, self._n_block))
            shape = (*blocks.shape[:2], self._n_block // 2 + 1)
            spectra = transforms.forward(threads=self._threads).reshape(shape)
            self._kernels.cross_spectra(spectra, int(self.bins[0]), self._sums)
            out = np.empty(self._sums.shape, np.complex64)
            self._lane.fetch(self._sums, out)
            self._lane.wait()
        out *= self._scale
        return Products(out, *self._slopes(pieces[np.ix_(self.channels, starts)]), n_blocks)

    def _intact(self, measurement: Measurement, first: int, n_blocks: int) -> NDArray[np.intp]:
        """Return the numbers of the blocks from a sample on that contain no dropout."""
        hop, intact = self._n_block // 2, np.ones(n_blocks, bool)
        per_sample = self._read.shape[1] / len(measurement.data)
        for start, stop in dropouts(measurement, self._read.settings):
            # The filter of a decimation spreads the ends of a dropout.
            begins, ends = (per_sample * each - first for each in (start, stop))
            low = math.floor((begins - _SPREAD - self._n_block) / hop) + 1
            intact[max(low, 0) : max(math.ceil((ends + _SPREAD) / hop), 0)] = False
        return np.flatnonzero(intact)

    def _slopes(self, pieces: NDArray[np.float32]) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
        """Return products of blocks (channel, block, sample) under the slope of the window, and powers."""
        # A tone with the spectrum X, and X′ with the slope, has the frequency -Im X′ / X relative to the bin's centre.
        first, stop = int(self.bins[0]), int(self.bins[-1]) + 1
        own, slope = (
            np.ascontiguousarray(
                scipy.fft.rfft(pieces * window, axis=2, workers=self._threads)[..., first:stop].transpose(2, 0, 1)
            )
            for window in (self._window, self._slope)
        )
        squares = (slope.real**2 + slope.imag**2).mean(axis=1).sum(axis=1, dtype=np.float64)
        products: NDArray[np.complex64] = slope @ own.conj().transpose(0, 2, 1)
        return self._scale * products, self._scale * squares

    def _planned(self, n_blocks: int) -> tuple[NDArray[np.float32], fft.Transforms]:
        """Return an array of the host for blocks, and the transforms of its copy on the device."""
        if n_blocks not in self._transforms:
            blocks = np.zeros((self._read.shape[0], n_blocks, self._n_block), np.float32)
            here = self._lane.send(blocks.reshape(-1, self._n_block))
            nothing = self._memory.zeros((1, 1, 1), np.complex64)
            plan = fft.plan(self._kernels.transforms, here, nothing, zeros=self._memory.zeros, stream=self._lane.stream)
            self._transforms[n_blocks] = blocks, plan
        return self._transforms[n_blocks]

    def close(self) -> None:
        """Free the memory of the device."""
        self._read.close()
        self._transforms.clear()
        self._memory.close()


def _spacing(settings: Settings, bands_hz: NDArray[np.float64], rate_hz: float) -> tuple[float, int]:
    """Return the spacing of the bins, and the number of samples of a block."""
    n_block = block_length(max(8, math.ceil(rate_hz / spacing_of(settings, bands_hz))))
    return rate_hz / n_block, n_block


def _too_narrow(settings: Settings, n_block: int, n_samples: int, rate_hz: float) -> str:
    """Return the message for a block that is longer than the record, with a width that suffices."""
    n_longest = next(n for n in range(n_samples, 0, -1) if n == 1 or block_length(n) <= n_samples)
    n_bins, key, what = 1, "passive.resolution_hz", "one"
    if settings.passive.resolution_hz is None:
        n_bins, key, what = BINS_OF_A_BAND, "passive.bands_hz", "bands"
    least_hz = math.ceil(n_bins * rate_hz / n_longest)
    return (
        f"{key} needs blocks of {n_block / rate_hz:.3g} s, longer than the record with {n_samples / rate_hz:.3g} s; "
        f"use {what} of at least {least_hz} Hz, or longer measurements"
    )
