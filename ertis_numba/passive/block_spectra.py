"""Spectra of blocks of a measurement: demodulation, window, and Fourier transform."""

import math
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba import fft
from ertis_numba.accepted_words import AcceptedWords
from ertis_numba.errors import ArgumentError, DataError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.kernels import KernelSet
from ertis_numba.passive.bands import band_edges
from ertis_numba.settings import Settings
from ertis_numba.stages.demodulate import demodulation
from ertis_numba.stages.time_window import TimeWindow
from ertis_numba.waveform import decimation_taps, integer_taps

__all__ = ["BlockSpectra"]

_RATE: Final = 2.5  # Signal rate relative to the highest frequency.
_MAX_SPACING_HZ: Final = 1e3
_BINS_OF_A_BAND: Final = 3
_RINGING_S: Final = 1e-3  # Time after the call in which the transducer and the filters ring.


class BlockSpectra:
    """Sums of the products of spectra over the blocks of measurements.

    Parameters
    ----------
    settings : Settings
    kernels : KernelSet
    threads : int

    Attributes
    ----------
    bands_hz : (band, 2) float64
        Edges of the bands.
    frequency_hz : (bin,) float64
        Frequencies of the bins that the bands need.
    bins : (bin,) uint32
        Their numbers; bin 1 has the frequency ``spacing_hz``.
    spacing_hz : float
        Spacing of the bins in hertz.

    Raises
    ------
    ArgumentError
        The bands exceed the record, or a block is longer than it.
    """

    def __init__(self, settings: Settings, kernels: KernelSet, *, threads: int) -> None:
        self._accepted_words = AcceptedWords(settings)
        self._kernels, self._threads = kernels, threads
        recording = settings.recording
        self.bands_hz = band_edges(settings.passive, highest_hz=recording.sample_rate_hz / _RATE)
        highest_hz = float(self.bands_hz.max())
        factor = max(1, math.floor(recording.sample_rate_hz / (_RATE * highest_hz)))
        rate_hz = recording.sample_rate_hz / factor
        self.spacing_hz, self._n_block = _spacing(settings, self.bands_hz, rate_hz)
        first = max(1, math.ceil(self.bands_hz.min() / self.spacing_hz - 0.5))
        stop = max(first + 2, math.floor(highest_hz / self.spacing_hz + 0.5) + 1)
        self.bins = np.arange(first, stop, dtype=np.uint32)
        self.frequency_hz = self.bins * self.spacing_hz

        layout = microphones(settings.array)
        self._gain = layout.gain[layout.enabled]
        n_samples = recording.n_samples // factor
        if self._n_block > n_samples:
            raise ArgumentError(
                f"a block of {self._n_block} samples, for frequencies {self.spacing_hz:g} Hz apart, is longer than the "
                f"record with {n_samples} samples; give wider bands, or a larger passive.resolution_hz"
            )
        self._memory = kernels.memory()
        self._lane = self._memory.lane()
        taps = decimation_taps(sample_rate_hz=recording.sample_rate_hz, decimation=factor, pass_hz=highest_hz)
        if factor == 1 and not recording.is_pdm:
            taps = taps[len(taps) // 2 :][:1]  # The other taps are 0.
        window = TimeWindow.from_start(n_samples, n_fft=n_samples)
        self._demodulate = demodulation(
            settings, layout, window, kernels, self._memory, taps=integer_taps(taps), factor=factor
        )
        self._room = self._demodulate.new_room()
        self._signals = self._memory.zeros(self._demodulate.shape, np.float32)
        self._heard = np.zeros(self._demodulate.shape, np.float32)
        self._window = scipy.signal.get_window("hann", self._n_block).astype(np.float32)
        power = self._n_block * float((self._window.astype(np.float64) ** 2).sum())
        self._scale = 2 / power / np.outer(self._gain, self._gain)
        self._masked = math.ceil((settings.call.end_s + _RINGING_S) * rate_hz)
        self.masked_s = self._masked / rate_hz
        self._transforms: dict[int, tuple[NDArray[np.float32], fft.Transforms]] = {}
        self._sums = self._memory.zeros((len(self.bins), len(self._gain), len(self._gain)), np.complex64)

    def products(self, measurement: Measurement, *, masked: bool) -> tuple[NDArray[np.complex64], int]:
        """Return the sum of the products over the blocks of a measurement, (bin, mic, mic), and their number.

        Parameters
        ----------
        measurement : Measurement
        masked : bool
            Leave out the time of the call.

        Raises
        ------
        DataError
            The measurement is not of this sensor, or is too short.
        """
        words, exponent = self._accepted_words.read(measurement)
        hop = self._n_block // 2
        first = self._masked if masked else 0
        n_blocks = (self._signals.shape[1] - first - self._n_block) // hop + 1
        if n_blocks < 1:
            raise DataError(
                f"a measurement has no block of {self._n_block} samples after its call; give wider bands, a larger "
                "passive.resolution_hz, or passive measurements"
            )
        blocks, transforms = self._planned(n_blocks)
        with self._kernels.threads(self._threads), self._lane.entered():
            self._demodulate(self._lane.send(words), self._room, self._signals)
            self._lane.fetch(self._signals, self._heard)
            self._lane.wait()
            pieces = np.lib.stride_tricks.sliding_window_view(self._heard[:, first:], self._n_block, axis=1)
            np.multiply(pieces[:, : n_blocks * hop : hop], self._window, out=blocks)
            self._lane.send(blocks.reshape(-1, self._n_block))
            shape = (*blocks.shape[:2], self._n_block // 2 + 1)
            spectra = transforms.forward(threads=self._threads).reshape(shape)
            self._kernels.cross_spectra(spectra, int(self.bins[0]), self._sums)
            out = np.empty(self._sums.shape, np.complex64)
            self._lane.fetch(self._sums, out)
            self._lane.wait()
        out *= self._scale.astype(np.float32) * np.float32(4.0**exponent)
        return out, n_blocks

    def _planned(self, n_blocks: int) -> tuple[NDArray[np.float32], fft.Transforms]:
        """Return an array of the host for blocks, and the transforms of its copy on the device."""
        if n_blocks not in self._transforms:
            blocks = np.zeros((len(self._gain), n_blocks, self._n_block), np.float32)
            here = self._lane.send(blocks.reshape(-1, self._n_block))
            nothing = self._memory.zeros((1, 1, 1), np.complex64)
            plan = fft.plan(self._kernels.transforms, here, nothing, zeros=self._memory.zeros, stream=self._lane.stream)
            self._transforms[n_blocks] = blocks, plan
        return self._transforms[n_blocks]

    def close(self) -> None:
        """Free the memory of the device."""
        self._transforms.clear()
        self._memory.close()


def _spacing(settings: Settings, bands_hz: NDArray[np.float64], rate_hz: float) -> tuple[float, int]:
    """Return the spacing of the bins, and the number of samples of a block."""
    widest_hz = settings.passive.resolution_hz
    if widest_hz is None:
        widest_hz = min(float(np.diff(bands_hz).min()) / _BINS_OF_A_BAND, _MAX_SPACING_HZ)
    n_block = scipy.fft.next_fast_len(max(8, math.ceil(rate_hz / widest_hz)), real=True)
    n_block += n_block % 2
    return rate_hz / n_block, n_block
