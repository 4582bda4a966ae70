"""From PDM words, or what would be modulated, to signals: low-pass, decimate, group delay removed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import Layout
from ertis_numba.kernels import KernelSet, Memory
from ertis_numba.settings import Settings
from ertis_numba.stages.window import TimeWindow

__all__ = ["Demodulate"]

# Of full scale, -260 dB. Signals that decay further become denormal numbers in this stage or the next, and an image of
# them would take 13 times as long.
_SILENCE = 1e-13


class Demodulate:
    """Words to signals.

    Attributes
    ----------
    shape : (mic, sample)
        Of the signals, zeros at the end included.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        window: TimeWindow,
        kernels: KernelSet,
        memory: Memory,
        *,
        taps: NDArray[np.int16] | NDArray[np.int32],
    ) -> None:
        self._kernels, self._memory = kernels, memory
        self._taps = memory.table(taps)
        self._scale = np.float32(1 / taps.sum(dtype=np.int64))
        self._plain_taps = memory.table((taps * np.float64(self._scale)).astype(np.float32))
        channels = np.flatnonzero(layout.enabled).astype(np.int32)
        self._channels = memory.table(channels)
        self._factor = settings.decimation
        self._window = window
        self.shape = (len(channels), window.n_fft)

    def __call__(self, words: NDArray[np.unsignedinteger[Any]], out: NDArray[np.float32]) -> None:
        """Fill ``out``, (mic, sample) float32, from ``words``, (sample, word)."""
        window = self._window
        self._kernels.demodulate_words(
            words, self._channels, self._taps, self._scale, self._factor, window.first_sample, window.n_samples, out
        )

    def filtered(self, signals: NDArray[np.float64], out: NDArray[np.float32]) -> None:
        """Fill ``out`` from signals that were never modulated, (mic, sample) at the PDM rate, full scale 1."""
        half, ahead = len(self._plain_taps) // 2, -(-len(self._plain_taps) // self._factor)
        count = self._window.n_samples
        first = (self._window.first_sample - ahead) * self._factor + half
        here = np.arange(first, first + (count + ahead) * self._factor)
        inside = (here >= 0) & (here < signals.shape[1])
        heard = np.zeros((len(signals), len(here)), dtype=np.float32)
        heard[:, inside] = signals[:, here[inside]]
        heard[np.abs(heard) < _SILENCE] = 0.0
        decimated = self._memory.zeros((len(signals), count + ahead), np.float32)
        self._kernels.decimate(self._memory.table(heard), self._plain_taps, self._factor, decimated)
        self._kernels.remove_group_delay(decimated, ahead, out)
