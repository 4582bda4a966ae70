"""Fast signal chain: it processes only the time window and the beams that an image needs."""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beam_grid import require_beam_grid
from ertis_numba.chain.beam_tables import BeamTables
from ertis_numba.chain.beamform import Beamform
from ertis_numba.chain.buffer_pool import MeasurementBuffers
from ertis_numba.chain.demodulate import FilterPcm, demodulation
from ertis_numba.chain.kernel_chain import KernelChain
from ertis_numba.chain.matched_filter import MatchedFilter
from ertis_numba.chain.phase_shifts import PhaseShifts
from ertis_numba.chain.plan_elements import chain_taps, ringing_db
from ertis_numba.chain.stream_beamform import StreamBeamform
from ertis_numba.chain.time_window import time_window
from ertis_numba.geometry import Grid, direction_grid, microphones
from ertis_numba.kernels import load_steering
from ertis_numba.settings import Settings

__all__ = ["FastChain"]

_TINY = 1e-30


class FastChain(KernelChain):
    """Signal chain that computes only the samples and beams of an image, for settings of `planner.complete`."""

    def _make(self, settings: Settings) -> None:
        memory, kernels = self._memory, self._kernels
        layout = microphones(settings.array)
        self.grid = direction_grid(settings.processing)
        self._tables = tables = BeamTables(settings, self.grid, threads=self._threads)
        taps, own_s = chain_taps(settings), tables.own_s
        self._window = window = time_window(
            settings,
            largest_delay_s=tables.largest_delay_s + tables.margin_s,
            n_taps=len(taps),
            ringing_db=ringing_db(settings),
        )
        if settings.accuracy.beam_taps:
            require_beam_grid(tables.aperture, len(window.range_m))
        self.range_m = window.range_m
        self._demodulate = demodulation(settings, layout, window, kernels, memory, taps=taps)
        self._made_unmodulated = functools.cache(
            lambda: FilterPcm(
                np.arange(len(own_s), dtype=np.int32), window, kernels, memory, taps=taps, factor=settings.decimation
            )
        )
        new_filter = functools.partial(MatchedFilter, settings, window, kernels, memory, taps=taps, n_mics=len(own_s))
        self._made_plain_filter = functools.cache(  # Only signal models need it.
            lambda: new_filter(gain=lambda frequency_hz: np.ones((1, len(frequency_hz)), np.complex128))
        )
        streams = tables.streams
        # Streams are calibrated before powers are taken. Otherwise, weights include the calibration.
        own_gain = layout.gain[layout.enabled] if streams else np.ones(len(own_s))

        def advanced(gains: Callable[[NDArray[np.float64]], NDArray[np.complex128]]) -> MatchedFilter:
            """Return the matched filter with gains, and the fractional-delay offset of each microphone."""
            turn = 2j * math.pi * tables.ahead_s[:, None]
            return new_filter(
                gain=lambda frequency_hz: gains(frequency_hz) / own_gain[:, None] * np.exp(turn * frequency_hz)
            )

        self._matched_filter: MatchedFilter = advanced(tables.gains)
        self._linear_filter = None if streams is None or streams.linear is None else advanced(streams.linear_gains)
        self._beamform = self._new_beamform(tables)

    def _turned(self, grid: Grid, threads: int) -> Beamform | PhaseShifts:
        steering = load_steering("numpy" if self._kernels.device == "numpy" else "auto")
        with steering.threads(threads):
            return self._new_beamform(self._tables.turned(grid, steering))

    def _new_beamform(self, tables: BeamTables) -> Beamform | PhaseShifts:
        return tables.beamform(self._kernels, self._memory, self._window, self._matched_filter)

    def analytic(self, words: NDArray[np.unsignedinteger[Any]]) -> tuple[NDArray[np.complex64], int]:
        """Return analytic signals, (mic, phase, sample), without plan gains, and the index of the first range."""
        heard = np.empty(self._matched_filter.shape, dtype=np.complex64)
        with self._taken(self._threads) as buffers:
            here = buffers.lane.send(words)
            self._demodulate(here, buffers.room, buffers.signals)
            self._made_plain_filter()(buffers.transforms, buffers.analytic, threads=self._threads)
            buffers.lane.fetch(buffers.analytic, heard)
        self._finish(buffers)
        return heard, self._window.lead

    def process_signals(self, signals: NDArray[np.float64], out: NDArray[np.float32]) -> None:
        """Compute an image from unmodulated signals: (mic, sample) at the PDM rate, full scale 1."""
        with self._taken(self._threads) as buffers:
            unmodulated, image = self._made_unmodulated(), buffers.lane.target(out)
            heard = np.where(np.abs(signals.T) < _TINY, 0.0, signals.T)  # Smaller values would become denormal numbers.
            numbers = buffers.lane.send(np.ascontiguousarray(heard, dtype=np.float32))
            unmodulated(numbers, unmodulated.new_room(), buffers.signals)
            self._image(buffers, image, self._threads)
            buffers.lane.fetch(image, out)
        self._finish(buffers)

    def _image(
        self,
        buffers: MeasurementBuffers,
        out: NDArray[np.float32],
        threads: int,
        beamform: Beamform | PhaseShifts | None = None,
    ) -> None:
        beamform = beamform or self._beamform
        if not isinstance(beamform, StreamBeamform):
            super()._image(buffers, out, threads, beamform)
            return
        transforms, analytic = buffers.transforms, buffers.analytic
        spectra = transforms.forward(threads=threads)
        self._matched_filter(transforms, analytic, threads=threads, spectra=spectra)
        linear, filtered = beamform.linear, self._linear_filter
        beamform.take(analytic, buffers.beamform, 1 if filtered and linear == 0 else 0)
        if filtered:
            filtered(transforms, analytic, threads=threads, spectra=spectra)
            beamform.take(analytic, buffers.beamform, linear, linear + 1)
        beamform.combine(buffers.beamform, out)
