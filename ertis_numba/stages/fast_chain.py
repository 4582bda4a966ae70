"""Fast signal chain: it processes only the time window and the beams that an image needs."""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.geometry import Grid, array_weights, delay_matrix, microphones, unit_vectors
from ertis_numba.kernels import KernelSet, Memory
from ertis_numba.settings import Settings
from ertis_numba.stages.adaptive import AdaptiveBeamform
from ertis_numba.stages.beam_grid import Aperture, require_beam_grid
from ertis_numba.stages.beamform import beamform
from ertis_numba.stages.buffer_pool import MeasurementBuffers
from ertis_numba.stages.delays import DelayTable, Zone
from ertis_numba.stages.demodulate import FilterPcm, demodulation
from ertis_numba.stages.interpolation_fit import Spectrum
from ertis_numba.stages.kernel_chain import KernelChain
from ertis_numba.stages.matched_filter import MatchedFilter
from ertis_numba.stages.phase_shifts import PhaseShifts
from ertis_numba.stages.plan_elements import (
    ahead_of,
    beam_grid_of,
    chain_taps,
    delay_fit,
    few_delays,
    nearest_m_of,
    ringing_db,
    spectrum_of,
    zones_of,
)
from ertis_numba.stages.stream_beamform import StreamBeamform, StreamTables, amplitudes_of_stream
from ertis_numba.stages.stream_plan import StreamPlanner
from ertis_numba.stages.stream_recipe import LINEAR, recipe_of, uses_streams
from ertis_numba.stages.time_window import time_window

__all__ = ["FastChain"]

_TINY = 1e-30


class FastChain(KernelChain):
    """Signal chain that computes only the samples and beams of an image; parameters and errors as for `KernelChain`.

    The settings have a complete plan: see `planner.complete`.
    """

    def _make(self, settings: Settings, grid: Grid) -> None:
        memory, kernels, threads = self._memory, self._kernels, self._threads
        plan = settings.accuracy
        layout = microphones(settings.array)
        self.grid = grid
        speed_m_s = sound_speed_m_s(settings.air)
        aperture = Aperture.of(layout.enabled_positions_m, unit_vectors(self.grid.azimuth_rad, self.grid.elevation_rad))
        spectrum = spectrum_of(settings)
        n_phases = plan.oversampling or 1
        streams = _Streams(settings, spectrum, aperture, speed_m_s) if uses_streams(settings.processing, plan) else None
        fit, step_s = delay_fit(settings, spectrum)
        nodes = None if streams else beam_grid_of(settings, aperture, spectrum)
        points = streams.points if streams else [aperture.directions if nodes is None else nodes.points]
        own_s = layout.delay_s[layout.enabled]
        array_weight = array_weights(settings)
        amplitudes = array_weight / (layout.gain[layout.enabled] * len(own_s))
        has_shifts = plan.delay_taps == 0
        ahead_s = np.zeros(len(own_s)) if has_shifts else ahead_of(array_weight, step_s)
        edges = zones_of(settings)
        waves_s = functools.partial(
            _delays_s, delay_matrix(settings, n_directions=len(self.grid)), aperture, sound_speed_m_s=speed_m_s
        )
        largest_s = max(
            float(np.max(np.abs(own_s + waves_s(some, range_m=range_m)))) for _, _, range_m in edges for some in points
        )
        taps = chain_taps(settings)
        window = time_window(
            settings,
            largest_delay_s=largest_s + (fit.n_taps // 2 + 2) * step_s,
            n_taps=len(taps),
            ringing_db=ringing_db(settings),
        )
        if plan.beam_taps:
            require_beam_grid(aperture, len(window.range_m))
        self.range_m = window.range_m
        self._lead = window.lead
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
        # Streams are calibrated before powers are taken. Otherwise, weights include the calibration.
        own_gain = layout.gain[layout.enabled] if streams else np.ones(len(own_s))

        def advanced(gains: Callable[[NDArray[np.float64]], NDArray[np.complex128]]) -> MatchedFilter:
            """Return the matched filter with gains, and the fractional-delay offset of each microphone."""
            return new_filter(
                gain=lambda frequency_hz: (
                    gains(frequency_hz) / own_gain[:, None] * np.exp(2j * math.pi * ahead_s[:, None] * frequency_hz)
                )
            )

        def plan_gains(frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
            if has_shifts:
                return np.repeat(amplitudes[:, None], len(frequency_hz), axis=1).astype(np.complex128)
            return np.asarray(fit.gain(frequency_hz) * (1 if nodes is None else nodes.gain(frequency_hz)))

        self._matched_filter = advanced(streams.plain_gains if streams else plan_gains)
        self._linear_filter = None if streams is None or streams.linear is None else advanced(streams.linear_gains)
        self._adaptive = None
        if streams is not None:
            taken_s = own_s - ahead_s
            self._beamform = streams.beamform(kernels, memory, taken_s, edges, n_phases=n_phases, lead=window.lead)
            return
        delayed = (
            (first, stop, own_s - ahead_s + waves_s(points[0], range_m=range_m)) for first, stop, range_m in edges
        )
        if has_shifts:
            self._beamform = PhaseShifts(kernels, memory, window, self._matched_filter, len(self.grid), delayed)
            return
        zones = [
            Zone(first, stop, DelayTable.of(delays_s, amplitudes, fit, n_phases=n_phases, lead=window.lead))
            for first, stop, delays_s in delayed
        ]
        self._beamform = beamform(
            plan.precision, kernels, memory, window, zones, nodes, n_phases=n_phases, threads=threads
        )
        if settings.processing.is_adaptive:
            table = zones[0].table
            self._adaptive = AdaptiveBeamform(
                settings.processing,
                kernels,
                memory,
                table.offsets(window.n_outputs),
                table.weights.astype(np.complex64),
                budget=10 ** (plan.max_error_db / 10),
            )

    def analytic(self, words: NDArray[np.unsignedinteger[Any]]) -> tuple[NDArray[np.complex64], int]:
        """Return the analytic signals, (mic, phase, sample), and the index of the sample at the first range.

        The gains and fractional-delay offsets of the plan are not applied.
        """
        heard = np.empty(self._matched_filter.shape, dtype=np.complex64)
        with self._taken(self._threads) as buffers:
            here = buffers.lane.send(words)
            self._demodulate(here, buffers.room, buffers.signals)
            self._made_plain_filter()(buffers.transforms, buffers.analytic, threads=self._threads)
            buffers.lane.fetch(buffers.analytic, heard)
        self._finish(buffers)
        return heard, self._lead

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

    def _image(self, buffers: MeasurementBuffers, out: NDArray[np.float32], threads: int) -> None:
        if isinstance(self._beamform, StreamBeamform):
            self._matched_filter(buffers.transforms, buffers.analytic, threads=threads)
            self._beamform.take(buffers.analytic, buffers.beamform)
            if self._linear_filter is not None:
                self._linear_filter(buffers.transforms, buffers.analytic, threads=threads)
                self._beamform.take(buffers.analytic, buffers.beamform, linear=True)
            self._beamform.combine(buffers.beamform, out)
        elif self._adaptive is None:
            super()._image(buffers, out, threads)
        else:
            self._matched_filter(buffers.transforms, buffers.analytic, threads=threads)
            self._adaptive(buffers.analytic, out)


def _delays_s(
    given_s: NDArray[np.float64] | None,
    aperture: Aperture,
    points: NDArray[np.float64],
    *,
    sound_speed_m_s: float,
    range_m: float,
) -> NDArray[np.float64]:
    """Return the given delays, or those of waves from points at a range: (point, mic) float64."""
    if given_s is not None:
        return given_s
    return aperture.delays_s(points, sound_speed_m_s=sound_speed_m_s, range_m=range_m)


class _Streams:
    """Streams of a complete plan, with the points whose beams are summed.

    Attributes
    ----------
    points : list of (point, axis) float64
        Beam-grid points of each stream, or the directions in the order of computation.
    linear : int or None
        Index of the stream of the signals themselves.
    """

    def __init__(self, settings: Settings, spectrum: Spectrum, aperture: Aperture, speed_m_s: float) -> None:
        plan, recipe = settings.accuracy, recipe_of(settings.processing)
        assert recipe is not None  # noqa: S101  `uses_streams` is true only with a recipe
        nearest_m, layout = nearest_m_of(settings), microphones(settings.array)
        planner = StreamPlanner(settings, recipe, spectrum, aperture, sound_speed_m_s=speed_m_s, nearest_m=nearest_m)
        n_phases, taps, density = plan.oversampling or 1, plan.beam_taps or 0, plan.beam_density or 2.0
        own_s, step_s = layout.delay_s[layout.enabled], 1 / (settings.output_rate_hz * n_phases)
        delays_s = few_delays(aperture, own_s, array_weights(settings), step_s, sound_speed_m_s=speed_m_s)
        self._recipe, self._aperture, self._speed_m_s = recipe, aperture, speed_m_s
        self._planned = planner.plan(n_phases, plan.delay_taps or 1, taps, density, delays_s)
        self._grids = [planner.beam_grid(each) for each in self._planned.streams]
        grids = (grid.rows for grid in self._grids if grid is not None)
        self._rows = next(grids, np.arange(len(aperture.directions), dtype=np.int32))
        ordered = aperture.directions[self._rows]
        self.points = [ordered if grid is None else grid.points for grid in self._grids]
        linear = (k for k, each in enumerate(self._planned.streams) if each.stream == LINEAR)
        self.linear = next(linear, None)

    def plain_gains(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the gains of the signals for nonlinear streams, which are 1."""
        return np.ones((1, len(frequency_hz)), dtype=np.complex128)

    def linear_gains(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the gains of the signals for the linear stream: (mic, frequency) or (1, frequency)."""
        assert self.linear is not None  # noqa: S101
        grid = self._grids[self.linear]
        gain = self._planned.streams[self.linear].fit.gain(frequency_hz)
        return np.asarray(gain * (1 if grid is None else grid.gain(frequency_hz)))

    def beamform(
        self,
        kernels: KernelSet,
        memory: Memory,
        own_s: NDArray[np.float64],
        edges: list[tuple[int, int, float]],
        *,
        n_phases: int,
        lead: int,
    ) -> StreamBeamform:
        """Return the beamformer of the streams for microphones with given delays."""
        tables = []
        for planned, nodes, points in zip(self._planned.streams, self._grids, self.points, strict=True):
            place = self._recipe.streams.index(planned.stream)
            amplitudes = amplitudes_of_stream(self._recipe, place, len(own_s))
            delays_s = (
                own_s + self._aperture.delays_s(points, sound_speed_m_s=self._speed_m_s, range_m=range_m)
                for _, _, range_m in edges
            )
            found = [
                DelayTable.of(each_s, amplitudes, planned.fit, n_phases=n_phases, lead=lead) for each_s in delays_s
            ]
            tables.append(StreamTables(nodes, found))
        zones = [(first, stop) for first, stop, _ in edges]
        return StreamBeamform(
            kernels, memory, self._recipe, self._planned, tables, self._rows, zones, n_phases=n_phases
        )
