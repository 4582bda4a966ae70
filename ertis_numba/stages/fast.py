"""The fast chain: only the window of the record, and only the beams, that the image needs."""

from queue import Empty, LifoQueue
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import fft
from ertis_numba.air import sound_speed_m_s
from ertis_numba.geometry import Grid, direction_grid, far_field_delays, microphones, unit_vectors
from ertis_numba.kernels import KernelSet
from ertis_numba.settings import Settings
from ertis_numba.stages.beamform import Beamform, Buffers, DelayTable, beamform
from ertis_numba.stages.demodulate import Demodulate
from ertis_numba.stages.matched_filter import MatchedFilter
from ertis_numba.stages.window import time_window
from ertis_numba.waveform import decimation_taps, matched_band_hz, whole_taps

__all__ = ["FastChain"]


class _Buffers(NamedTuple):
    signals: NDArray[np.float32]
    analytic: NDArray[np.complex64]
    beamform: Buffers


class FastChain:
    """Demodulate, matched filter, beamform and envelope with tables made once.

    Attributes
    ----------
    grid : Grid
    range_m : (range,) float64
    """

    def __init__(self, settings: Settings, kernels: KernelSet, *, threads: int) -> None:
        layout = microphones(settings.array)
        self.grid: Grid = direction_grid(settings.processing)
        delays_s = layout.delay_s[layout.enabled] + far_field_delays(
            layout.enabled_positions_m,
            unit_vectors(self.grid.azimuth_rad, self.grid.elevation_rad),
            sound_speed_m_s=sound_speed_m_s(settings.air),
        )
        taps = whole_taps(
            decimation_taps(
                pdm_rate_hz=settings.recording.pdm_rate_hz,
                decimation=settings.decimation,
                pass_hz=matched_band_hz(settings.call)[1],
            )
        )
        window = time_window(settings, largest_delay_s=float(np.max(np.abs(delays_s))), n_taps=len(taps))
        self.range_m = window.range_m
        self._kernels = kernels
        self._threads = threads
        self._demodulate = Demodulate(settings, layout, window, kernels, taps=taps)
        self._matched_filter = MatchedFilter(
            settings, window, kernels, fft.load(kernels.device), taps=taps, n_mics=delays_s.shape[1]
        )
        table = DelayTable.of(
            delays_s,
            1 / (layout.gain[layout.enabled] * delays_s.shape[1]),
            settings,
            window,
            centre_hz=self._matched_filter.centre_hz,
        )
        self._beamform: Beamform = beamform(settings, window, kernels, table)
        self._spare: LifoQueue[_Buffers] = LifoQueue()

    def process(self, words: NDArray[np.unsignedinteger[Any]], out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``words``, (sample, word)."""
        buffers = self._take_buffers()
        with self._kernels.threads(self._threads):
            self._demodulate(words, buffers.signals)
            self._finish(buffers, out)

    def process_signals(self, signals: NDArray[np.float64], out: NDArray[np.float32]) -> None:
        """Fill ``out`` from what would be modulated, (mic, sample) at the PDM rate, full scale 1."""
        buffers = self._take_buffers()
        with self._kernels.threads(self._threads):
            self._demodulate.filtered(signals, buffers.signals)
            self._finish(buffers, out)

    def _finish(self, buffers: _Buffers, out: NDArray[np.float32]) -> None:
        self._matched_filter(buffers.signals, buffers.analytic, threads=self._threads)
        self._beamform(buffers.analytic, buffers.beamform, out)
        self._spare.put(buffers)

    def _take_buffers(self) -> _Buffers:
        """Return buffers that no other thread uses; there are as many as ever ran at once."""
        try:
            return self._spare.get_nowait()
        except Empty:
            return _Buffers(
                np.zeros(self._demodulate.shape, dtype=np.float32),
                np.zeros(self._matched_filter.shape, dtype=np.complex64),
                self._beamform.new_buffers(),
            )
