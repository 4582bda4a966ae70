"""Demodulation of PDM bits or PCM samples to signals: low-pass filter, decimation, and removal of the group delay."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.geometry import Layout
from ertis_numba.kernels import KernelSet, Memory
from ertis_numba.settings import Settings

__all__ = ["Demodulate", "DemodulatePdm", "FilterPcm", "demodulation"]

# Samples below -260 dB of full scale count as 0. Smaller values become denormal numbers in this stage or the next, and
# an image of denormal numbers takes 13 times as long.
_SILENCE = 1e-13

Room = tuple[NDArray[np.float32], ...]


class Demodulate(Protocol):
    """Demodulation stage: signals (mic, sample), with the zeros at the end, from recorded samples."""

    shape: tuple[int, int]

    def new_room(self) -> Room:
        """Return new work arrays for one measurement at a time."""
        ...

    def __call__(self, words: NDArray[Any], room: Room, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (mic, sample) float32, from ``words``, (sample, word) or (sample, channel)."""
        ...


def demodulation(
    settings: Settings,
    layout: Layout,
    window: TimeWindow,
    kernels: KernelSet,
    memory: Memory,
    *,
    taps: NDArray[np.int16] | NDArray[np.int32],
    factor: int | None = None,
) -> Demodulate:
    """Return the demodulation stage for PDM or PCM; ``factor`` is the number of recorded samples per signal sample."""
    channels = np.flatnonzero(layout.enabled).astype(np.int32)
    recording, factor = settings.recording, factor or settings.decimation
    if recording.is_pdm:
        return DemodulatePdm(channels, window, kernels, memory, taps=taps, factor=factor)
    return FilterPcm(channels, window, kernels, memory, taps=taps, factor=factor, full_scale=recording.full_scale)


class DemodulatePdm:
    """Demodulation of PDM bits in one pass, with a full scale of 1; the sum of the integer taps is a gain of 1."""

    def __init__(
        self,
        channels: NDArray[np.int32],
        window: TimeWindow,
        kernels: KernelSet,
        memory: Memory,
        *,
        taps: NDArray[np.int16] | NDArray[np.int32],
        factor: int,
    ) -> None:
        self._kernel = kernels.demodulate_words
        self._taps, self._scale = memory.table(taps), np.float32(1 / taps.sum(dtype=np.int64))
        self._channels, self._factor, self._window = memory.table(channels), factor, window
        self.shape = (len(channels), window.n_fft)

    def new_room(self) -> Room:
        """Return no work arrays, since bits are demodulated in one pass."""
        return ()

    def __call__(self, words: NDArray[Any], room: Room, out: NDArray[np.float32]) -> None:  # noqa: ARG002
        """Fill ``out``, (mic, sample) float32, from ``words``, (sample, word) unsigned integers."""
        window = self._window
        self._kernel(
            words, self._channels, self._taps, self._scale, self._factor, window.first_sample, window.n_samples, out
        )

    @property
    def n_signals(self) -> int:
        """Number of signal samples without the zeros at the end."""
        return self._window.n_samples

    def n_ready(self, n_words: int) -> int:
        """Return the number of signal samples that depend on the first words only."""
        n_taps, window = len(self._taps), self._window
        n_samples = (n_words + n_taps // 2 - n_taps) // self._factor - window.first_sample + 1
        return min(max(0, n_samples), window.n_samples)

    def part(self, words: NDArray[Any], first: int, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (mic, n), with the signal samples from ``first`` on; they have the same bits as of a call."""
        window = self._window
        n_samples = min(max(0, window.n_samples - first), out.shape[1])
        self._kernel(
            words, self._channels, self._taps, self._scale, self._factor, window.first_sample + first, n_samples, out
        )


class FilterPcm:
    """Low-pass filter and decimation of PCM, whose rate may exceed the signal rate; ``full_scale`` becomes 1."""

    def __init__(
        self,
        channels: NDArray[np.int32],
        window: TimeWindow,
        kernels: KernelSet,
        memory: Memory,
        *,
        taps: NDArray[np.int16] | NDArray[np.int32],
        factor: int,
        full_scale: float = 1.0,
    ) -> None:
        self._kernels, self._memory = kernels, memory
        self._taps = memory.table((taps / taps.sum(dtype=np.int64)).astype(np.float32))
        self._scale, self._silence = np.float32(1 / full_scale), np.float32(full_scale * _SILENCE)
        self._channels, self._factor = memory.table(channels), factor
        self._ahead = -(-len(taps) // factor)
        self._first = (window.first_sample - self._ahead) * factor + len(taps) // 2
        self._n_decimated = window.n_samples + self._ahead
        self.shape = (len(channels), window.n_fft)

    def new_room(self) -> Room:
        """Return the arrays of unpacked and of decimated samples for one measurement at a time."""
        n_mics = self.shape[0]
        return (
            self._memory.zeros((n_mics, self._n_decimated * self._factor), np.float32),
            self._memory.zeros((n_mics, self._n_decimated), np.float32),
        )

    def __call__(self, words: NDArray[Any], room: Room, out: NDArray[np.float32]) -> None:
        """Fill ``out``, (mic, sample) float32, from ``words``, (sample, channel)."""
        heard, decimated = room
        self._kernels.unpack_pcm(words, self._channels, self._scale, self._silence, self._first, heard)
        self._kernels.decimate(heard, self._taps, self._factor, decimated)
        self._kernels.remove_group_delay(decimated, self._ahead, out)
