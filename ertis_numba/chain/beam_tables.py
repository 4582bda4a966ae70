"""Tables of a complete plan for the directions of an image, and for those of a tilted sensor."""

import copy
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.adaptive import AdaptiveBeamform
from ertis_numba.chain.beam_grid import Aperture
from ertis_numba.chain.beamform import Beamform, beamform
from ertis_numba.chain.delays import DelayTable, Zone
from ertis_numba.chain.interpolation_fit import Spectrum
from ertis_numba.chain.matched_filter import MatchedFilter
from ertis_numba.chain.phase_shifts import PhaseShifts
from ertis_numba.chain.plan_elements import (
    ahead_of,
    beam_grid_of,
    delay_fit,
    few_delays,
    nearest_m_of,
    spectrum_of,
    zones_of,
)
from ertis_numba.chain.row_beams import row_tables
from ertis_numba.chain.stream_beamform import StreamBeamform, StreamTables, amplitudes_of_stream
from ertis_numba.chain.stream_plan import StreamPlanner
from ertis_numba.chain.stream_recipe import LINEAR, recipe_of, uses_streams
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.geometry import Grid, array_weights, delay_matrix, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.kernels import KernelSet, Memory, SteeringKernels
from ertis_numba.settings import Settings

__all__ = ["BeamTables", "PlanStreams"]

_Edges = list[tuple[int, int, float]]


class BeamTables:
    """Fits of a complete plan, and the tables of its beamformer for some directions."""

    # `own_s` and `ahead_s` (mic,) are delays and fractional-delay offsets; `margin_s` is the reach of interpolation.

    def __init__(self, settings: Settings, grid: Grid, *, threads: int) -> None:
        plan, layout, spectrum = settings.accuracy, microphones(settings.array), spectrum_of(settings)
        self._settings, self._threads = settings, threads
        self._speed_m_s = sound_speed_m_s(settings.air)
        self._given_s = delay_matrix(settings, n_directions=len(grid))
        self.aperture = Aperture.of(
            layout.enabled_positions_m,
            unit_vectors(grid.azimuth_rad, grid.elevation_rad),
            is_turned=settings.processing.level_directions,
        )
        self._directions = self.aperture.directions
        self._steering: SteeringKernels | None = None
        self._fit, step_s = delay_fit(settings, spectrum)
        self.streams = None
        if uses_streams(settings.processing, plan):
            self.streams = PlanStreams(settings, spectrum, self.aperture, self._speed_m_s)
        self._nodes = None if self.streams else beam_grid_of(settings, self.aperture, spectrum)
        self._rows = row_tables(settings, self.aperture, self._nodes, self._fit, spectrum) if plan.row_beams else None
        self._has_shifts = plan.delay_taps == 0
        self.own_s, weights = layout.delay_s[layout.enabled], array_weights(settings)
        self._amplitudes = weights / (layout.gain[layout.enabled] * len(self.own_s))
        self.ahead_s = np.zeros(len(self.own_s)) if self._has_shifts else ahead_of(weights, step_s)
        self._edges = zones_of(settings)
        self.margin_s = (self._fit.n_taps // 2 + 2) * step_s * (1 if self._rows is None else 2)
        self.largest_delay_s = self._largest_delay_s()

    def turned(self, grid: Grid, steering: SteeringKernels) -> Self:
        """Return the tables for the same number of other directions; the settings must have level directions."""
        directions = self.aperture.turned(unit_vectors(grid.azimuth_rad, grid.elevation_rad)).directions
        other = copy.copy(self)
        other._directions, other._steering = directions, steering  # noqa: SLF001  of the same class
        other._nodes = None if self._nodes is None else self._nodes.turned(directions, steering)  # noqa: SLF001
        other.streams = None if self.streams is None else self.streams.turned(directions, steering)
        return other

    def gains(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the gains of the signals that complement the tables: (mic, frequency) or (1, frequency)."""
        if self.streams is not None:
            return np.ones((1, len(frequency_hz)), dtype=np.complex128)
        if self._has_shifts:
            return np.repeat(self._amplitudes[:, None], len(frequency_hz), axis=1).astype(np.complex128)
        gain = self._fit.gain(frequency_hz) * (1 if self._nodes is None else self._nodes.gain(frequency_hz))
        return np.asarray(gain if self._rows is None else gain * self._rows.gain(frequency_hz))

    def beamform(
        self, kernels: KernelSet, memory: Memory, window: TimeWindow, matched_filter: MatchedFilter
    ) -> Beamform | PhaseShifts:
        """Return the beamformer; the gains of the matched filter include `gains`."""
        plan, n_phases = self._settings.accuracy, self._settings.accuracy.oversampling or 1
        # Buffers must have room for any directions of a tilted sensor.
        last_sample = 2 * window.lead if self.aperture.is_turned else None
        if self._rows is not None:
            return self._rows.beamform(
                kernels, memory, window, self._edges, self.own_s - self.ahead_s, self._amplitudes,
                n_phases=n_phases, rate_hz=self._settings.output_rate_hz, threads=self._threads,
            )  # fmt: skip
        points = self._points[0]
        delayed = (
            (first, stop, self.own_s - self.ahead_s + self._waves_s(points, range_m))
            for first, stop, range_m in self._edges
        )
        if self._has_shifts:
            return PhaseShifts(kernels, memory, window, matched_filter, len(self._directions), delayed)
        if self.streams is not None:
            return self.streams.beamform(
                kernels, memory, self.own_s - self.ahead_s, self._edges, self._steering,
                n_phases=n_phases, lead=window.lead, last_sample=last_sample,
            )  # fmt: skip
        zones = [
            Zone(
                first,
                stop,
                DelayTable.of(
                    delays_s, self._amplitudes, self._fit, self._steering, n_phases=n_phases, lead=window.lead
                ),
            )
            for first, stop, delays_s in delayed
        ]
        if self._settings.processing.is_adaptive:
            return AdaptiveBeamform(
                self._settings.processing,
                kernels,
                memory,
                zones[0].table.offsets(window.n_outputs),
                zones[0].table.weights.astype(np.complex64),
                budget=10 ** (plan.max_error_db / 10),
            )
        return beamform(
            plan.precision, kernels, memory, window, zones, self._nodes,
            n_phases=n_phases, threads=self._threads, last_sample=last_sample,
        )  # fmt: skip

    @property
    def _points(self) -> list[NDArray[np.float64]]:
        """Points whose beams are summed, for each stream."""
        if self.streams is not None:
            return self.streams.points
        return [self._directions if self._nodes is None else self._nodes.points]

    def _waves_s(self, points: NDArray[np.float64], range_m: float) -> NDArray[np.float64]:
        """Return the given delays, or those of waves from points at a range: (point, mic) float64."""
        if self._given_s is not None:
            return self._given_s
        return self.aperture.delays_s(points, sound_speed_m_s=self._speed_m_s, range_m=range_m)

    def _largest_delay_s(self) -> float:
        if self.aperture.is_turned:
            reach = 1.0 if self._nodes is None else self._nodes.reach
            reach = reach if self.streams is None else self.streams.reach
            return self.aperture.largest_delay_s(reach, self.own_s, sound_speed_m_s=self._speed_m_s)
        if self._rows is not None:
            return self._rows.largest_delay_s(self.own_s, [range_m for *_, range_m in self._edges])
        return max(
            float(np.max(np.abs(self.own_s + self._waves_s(some, range_m))))
            for _, _, range_m in self._edges
            for some in self._points
        )


class PlanStreams:
    """Streams of a complete plan, with the points (point, axis) of each whose beams are summed."""

    # They are those of a beam grid, or the directions in the order of computation, within `reach` of the centre.

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
        self.reach = max([1.0, *(grid.reach for grid in self._grids if grid is not None)])
        self._place(aperture.directions)
        linear = (k for k, each in enumerate(self._planned.streams) if each.stream == LINEAR)
        self.linear = next(linear, None)

    def turned(self, directions: NDArray[np.float64], steering: SteeringKernels) -> Self:
        """Return the streams for other directions, (direction, axis) as those of `Aperture`."""
        other = copy.copy(self)
        other._grids = [None if grid is None else grid.turned(directions, steering) for grid in self._grids]  # noqa: SLF001
        other._place(directions)  # noqa: SLF001  of the same class
        return other

    def _place(self, directions: NDArray[np.float64]) -> None:
        """Order the directions as the first beam grid does, and choose the points of each stream."""
        grids = (grid.rows for grid in self._grids if grid is not None)
        self._rows = next(grids, np.arange(len(directions), dtype=np.int32))
        ordered = directions[self._rows]
        self.points = [ordered if grid is None else grid.points for grid in self._grids]

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
        steering: SteeringKernels | None,
        *,
        n_phases: int,
        lead: int,
        last_sample: int | None,
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
                DelayTable.of(each_s, amplitudes, planned.fit, steering, n_phases=n_phases, lead=lead)
                for each_s in delays_s
            ]
            tables.append(StreamTables(nodes, found))
        zones = [(first, stop) for first, stop, _ in edges]
        return StreamBeamform(
            kernels, memory, self._recipe, self._planned, tables, self._rows, zones,
            n_phases=n_phases, last_sample=last_sample,
        )  # fmt: skip
