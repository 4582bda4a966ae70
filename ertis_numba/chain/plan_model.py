"""Predicted error, work and memory of complete plans."""

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.beam_grid import FEWEST_RANGES, BeamGrid, require_beam_grid
from ertis_numba.chain.beamform import whole_limits
from ertis_numba.chain.costs import Work
from ertis_numba.chain.error_model import PARTS, ErrorModel, SignalModel
from ertis_numba.chain.focal_zones import squared_curvature
from ertis_numba.chain.instance_cache import cached_in_instance
from ertis_numba.chain.phase_shifts import SHIFT_BYTES, SHIFT_TABLE_BYTES, rows_at_a_time
from ertis_numba.chain.plan_elements import (
    PlannedBeams,
    aperture_of,
    chain_taps,
    estimated,
    estimated_errors,
    few_delays,
    fitted,
    grid_points,
    nearest_m_of,
    planned_rows,
    require_rows,
    ringing_db,
    spectrum_of,
    zones_of,
)
from ertis_numba.chain.planned_rows import PlannedRows
from ertis_numba.chain.planned_streams import PlannedStreams
from ertis_numba.chain.sensitivity import Sensitivity
from ertis_numba.chain.stream_plan import StreamPlanner
from ertis_numba.chain.stream_recipe import LINEAR, recipe_of, uses_streams
from ertis_numba.chain.time_window import TimeWindow, time_window
from ertis_numba.geometry import array_weights, direction_grid, effective_count, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import matched_band_hz, matched_guard_s
from ertis_numba.settings import Accuracy, Settings
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS

__all__ = ["MIN_STOPBAND_ATTENUATION_DB", "TABLE_BYTES", "Delays", "ImagePlan", "Nodes", "PlanModel", "plan_of"]

MIN_STOPBAND_ATTENUATION_DB = 40.0
TABLE_BYTES = 44
"""Bytes of a delay and a weight, including both the computed form and the form that kernels read."""

_COHERENCE_ERROR = 10**-4.8
"""Error power of the coherence factor from streams. Finer interpolation hardly reduces it.

Echoes of `data/synthetic/reflectors.h5` had −48.3 to −49.2 dB with plans for budgets from −40 to −68 dB.
"""


_ALONG_ROWS = 2.0
"""Margin on errors of interpolation along rows, which are alike in all rows, from scenes of test_row_beams.py."""


class ImagePlan(NamedTuple):
    """Complete plan: a value for every accuracy setting."""

    precision: str
    n_phases: int
    delay_taps: int
    beam_taps: int
    density: float
    stopband_attenuation_db: float
    focal_zones: int
    row_beams: bool = False


@dataclass(frozen=True, slots=True)
class Nodes:
    """Predicted size and error of a beam grid, and sum of a beam's squared weights; ``grid`` needs a measured model."""

    count: int
    n_pairs: int
    error: float
    squares: float
    grid: BeamGrid | None = None


@dataclass(frozen=True, slots=True)
class Delays:
    """Predicted properties of a delay interpolation."""

    n_taps: int
    error: float
    sum_of_weights: float
    squares: float


class PlanModel:
    """Predictions about complete plans for one kind of measurement; without a signal model, they are safe values."""

    def __init__(self, settings: Settings, signal_model: SignalModel | None, *, tile_ranges: int) -> None:
        self.settings = settings
        self._tile_ranges = tile_ranges
        self.errors = ErrorModel(settings, signal_model)
        self._spectrum = spectrum_of(settings)
        layout, grid = microphones(settings.array), direction_grid(settings.processing)
        self.n_mics, self._n_words = int(layout.enabled.sum()), layout.n_words
        self._own_s = layout.delay_s[layout.enabled]
        self.aperture = aperture_of(
            layout.enabled_positions_m.tobytes(),
            unit_vectors(grid.azimuth_rad, grid.elevation_rad).tobytes(),
            settings.processing.level_directions,
        )
        self._weights = array_weights(settings)
        amplitudes = self._weights / layout.gain[layout.enabled]
        self._spread = float(np.max(amplitudes**2) / np.mean(amplitudes**2))  # The largest amplitude sets the scale.
        self._n_effective = effective_count(self._weights)
        self.n_directions = len(grid)
        self._speed_m_s = sound_speed_m_s(settings.air)
        self._nearest_m = nearest_m_of(settings)
        self.window = time_window(settings, largest_delay_s=self._reach_s(), n_taps=1)
        if settings.accuracy.beam_taps:
            require_beam_grid(self.aperture, len(self.window.range_m))
        if settings.accuracy.row_beams:
            require_rows(settings, self.aperture)
        rows = planned_rows(self.aperture)
        self.rows = (
            None
            if rows is None
            else PlannedRows(rows, self.aperture, nearest_m=self._nearest_m, sound_speed_m_s=self._speed_m_s)
        )
        recipe = recipe_of(settings.processing)
        self.has_streams = settings.processing.is_adaptive and recipe is not None
        self._stream_planner = (
            StreamPlanner(
                settings,
                recipe,
                self._spectrum,
                self.aperture,
                sound_speed_m_s=self._speed_m_s,
                nearest_m=self._nearest_m,
            )
            if recipe is not None
            else None
        )

    def parts(self, plan: ImagePlan, *, noise_only: bool = False) -> dict[str, float]:
        """Return the error power of each step of a plan, relative to the exact image of delay-and-sum."""
        if self.uses_streams(plan):
            return self._stream_parts(plan, noise_only=noise_only)
        parts = self._common_parts(plan)
        if not plan.delay_taps:
            parts["arithmetic"] += self.errors.phases(self._n_bins(self._windows(plan.stopband_attenuation_db)))
            return parts
        delays = self.delays(plan.n_phases, plan.delay_taps)
        nodes = self.nodes(plan.beam_taps, plan.density) if plan.beam_taps else None
        parts["delays"] = delays.error
        if nodes is not None:
            parts["beams"] = nodes.error
            parts["delays"] = self._delays_between(nodes, plan, delays.error)
        if plan.row_beams and nodes is not None:
            return self._row_parts(parts, plan, delays, nodes)
        if plan.precision == "int16":
            parts["samples"] = self._spread * self._whole_numbers(delays, None if nodes is None else nodes.squares)
        return parts

    def _row_parts(self, parts: dict[str, float], plan: ImagePlan, delays: Delays, nodes: Nodes) -> dict[str, float]:
        """Add the error powers of beams of rows to those of the microphones; 16 bits hold beams of rows only."""
        assert self.rows is not None  # noqa: S101
        rows, passed = self.rows, max(1.0, nodes.squares)
        fit, _ = fitted(self._spectrum, plan.delay_taps, 1 / (self.settings.output_rate_hz * plan.n_phases))
        again = self.errors.delays(fit, n_mics=len(rows.rows)) + 2 * self.errors.shared_delays(fit)
        parts["delays"] = passed * (delays.error + again)
        parts["beams"] += self._row_delay_error
        squares = nodes.squares
        if rows.is_curved:
            power, along = estimated_errors(self._row_beams(plan))
            parts["beams"] += _ALONG_ROWS * passed * self.errors.uniform_beams(power)
            squares *= max(1.0, along)
        n_terms = len(rows.rows) * (plan.beam_taps if rows.is_curved else 1)
        per_row = self.n_mics / len(rows.rows)  # A beam of a row may exceed the others by so much.
        parts["samples"] = self._spread * per_row * self._whole_numbers(delays, squares, n_terms)
        return parts

    @functools.cached_property
    def _row_delay_error(self) -> float:
        return 0.0 if self.rows is None else self.rows.delay_error(self.errors, self.window.range_m)

    def _row_beams(self, plan: ImagePlan) -> PlannedBeams:
        assert self.rows is not None  # noqa: S101
        return self._beams(plan.beam_taps, plan.density)._replace(aperture=self.rows.line)

    def _common_parts(self, plan: ImagePlan) -> dict[str, float]:
        """Return the error power of the steps that every plan has."""
        parts = dict.fromkeys(PARTS, 0.0)
        parts["filter"], parts["window"] = self._band_errors(plan.stopband_attenuation_db)
        parts["arithmetic"] = self.errors.arithmetic()
        if self.settings.processing.wavefront == "spherical":
            parts["zones"] = self.zone_error(plan.focal_zones)
        return parts

    @cached_in_instance
    def _band_errors(self, stopband_attenuation_db: float) -> tuple[float, float]:
        """Return the error powers of the decimation filter and of the ringing that its plan's window cuts off."""
        taps, filter_error = self.filter(stopband_attenuation_db)
        guard_s = matched_guard_s(self.settings, down_db=self._ringing_db(stopband_attenuation_db))
        imaged_s = len(self.window.range_m) / self.settings.output_rate_hz
        return filter_error, self.errors.window(taps, guard_s=guard_s, imaged_s=imaged_s)

    def uses_streams(self, plan: ImagePlan) -> bool:
        """Return True if a plan computes an adaptive beamformer from streams."""
        return uses_streams(self.settings.processing, plan)

    def _stream_parts(self, plan: ImagePlan, *, noise_only: bool) -> dict[str, float]:
        assert self._stream_planner is not None  # noqa: S101
        planned, kind = self.streams(plan), "noise" if noise_only else "echoes"
        linear = Sensitivity.of(self.settings.processing, self.n_mics).linear
        parts = self._common_parts(plan)
        amplified = 1.0
        for each in planned.streams:
            squares = None
            if each.grid is not None:
                squares = each.grid.squares
                parts["beams"] += getattr(each.grid.errors, kind) / linear
                amplified = max(amplified, squares)
            if plan.precision == "int16":
                weights = np.abs(each.fit.weights(each.fit.fractions))
                delays = Delays(
                    n_taps=each.fit.n_taps,
                    error=0.0,
                    sum_of_weights=float(np.max(weights.sum(axis=1))),
                    squares=float(np.mean(np.sum(weights**2, axis=1))),
                )
                parts["samples"] += each.shares.noise * self._whole_numbers(delays, squares) / linear
        parts["delays"] = getattr(planned.delays, kind) * amplified / linear
        if self.settings.processing.weighting != "none":
            parts["samples"] += _COHERENCE_ERROR / linear
        return parts

    @cached_in_instance
    def streams(self, plan: ImagePlan) -> PlannedStreams:
        """Return the streams of a plan."""
        assert self._stream_planner is not None  # noqa: S101
        delays_s = self._few_delays(1 / (self.settings.output_rate_hz * plan.n_phases))
        return self._stream_planner.plan(plan.n_phases, plan.delay_taps, plan.beam_taps, plan.density, delays_s)

    def _delays_between(self, nodes: Nodes, plan: ImagePlan, error: float) -> float:
        """Return the error power of delays in beams that are interpolated between beam-grid points."""
        # The interpolation suppresses errors that differ between grid points, such as images of the spectrum.
        step_s = 1 / (self.settings.output_rate_hz * plan.n_phases)
        fit, _ = fitted(self._spectrum, plan.delay_taps, step_s)
        if nodes.grid is None or self._few_delays(step_s) is not None:
            return error * max(1.0, nodes.squares)
        passed = sum(share * nodes.grid.passed(order / step_s) for order, share in fit.images.items())
        return self.errors.delays(fit, n_mics=self._n_effective, passed=np.asarray(passed))

    def work(self, plan: ImagePlan) -> Work:
        """Return the work of a plan, from which its time is predicted."""
        streamed = self.uses_streams(plan)
        nodes = self.nodes(plan.beam_taps, plan.density) if plan.beam_taps and not streamed else None
        n_beams, n_terms = self.n_directions if nodes is None else nodes.count, self.n_mics * plan.delay_taps
        n_pairs = 0 if nodes is None else nodes.n_pairs
        if streamed:
            streams = self.streams(plan).streams
            n_terms = self.n_mics
            n_beams = sum(
                (each.grid.n_points if each.grid else self.n_directions) * each.fit.n_taps for each in streams
            )
            n_pairs = sum(each.grid.n_pairs for each in streams if each.grid)
        n_rows = n_row_terms = 0
        if plan.row_beams and self.rows is not None:
            n_rows, n_row_terms = self._row_counts(plan)
            n_terms = len(self.rows.rows) * plan.delay_taps * (plan.beam_taps if self.rows.is_curved else 1)
        taps, _ = self.filter(plan.stopband_attenuation_db)
        # Phase shifts take a transform per direction, so that its length matters.
        window = self.window if plan.delay_taps else self._windows(plan.stopband_attenuation_db)
        tile = self._tile_ranges if plan.precision == "int16" else FEWEST_RANGES
        return Work(
            n_mics=self.n_mics,
            n_words=self._n_words,
            n_samples=window.n_samples,
            n_taps=len(taps),
            tap_bits=8 * taps.dtype.itemsize,
            n_fft=window.n_fft,
            n_bins=self._n_bins(window),
            n_phases=plan.n_phases,
            n_outputs=window.n_outputs,
            n_directions=self.n_directions,
            n_ranges=len(self.window.range_m),
            n_computed=tile * sum(-(-(stop - first) // tile) for first, stop, _ in self._zones(plan.focal_zones)),
            n_beams=n_beams,
            n_terms=n_terms,
            n_pairs=n_pairs,
            precision=plan.precision,
            n_shifted=0 if plan.delay_taps else self.n_directions * len(self._zones(plan.focal_zones)),
            n_streams=len(self.streams(plan).streams) if streamed else 0,
            n_filters=2 if streamed and any(each.stream == LINEAR for each in self.streams(plan).streams) else 1,
            n_rows=n_rows,
            n_row_terms=n_row_terms,
            term_cost=1.0 if streamed else self._kernel_cost(),
        )

    def _row_counts(self, plan: ImagePlan) -> tuple[int, int]:
        """Return the number of beams of rows, and that of the products of their samples in all focal zones."""
        assert self.rows is not None  # noqa: S101
        high_hz, rows = self.settings.call.high_frequency_hz, self.rows
        spacing = self.aperture.spacing(plan.density, high_hz=high_hz, sound_speed_m_s=self._speed_m_s)
        n_beams = len(rows.rows) * rows.count_points(spacing, plan.beam_taps)
        more = 2 * math.ceil(rows.reach_s * self.settings.output_rate_hz + plan.delay_taps / plan.n_phases)
        n_samples = sum(stop - first + more for first, stop, _ in self._zones(plan.focal_zones))
        return n_beams, n_beams * plan.n_phases * n_samples * rows.rows.most * plan.delay_taps

    def _kernel_cost(self) -> float:
        """Return the time of the kernels of all microphones, relative to delay-and-sum in single precision."""
        processing = self.settings.processing
        beamformer = BEAMFORMERS[processing.beamformer]
        return beamformer.cost(*beamformer.values(processing)) + WEIGHTINGS[processing.weighting].cost

    def n_bytes(self, plan: ImagePlan) -> int:
        """Return the memory of a plan's signals and delays, in bytes."""
        signals = 16 * self.n_mics * plan.n_phases * self.window.n_outputs
        if self.uses_streams(plan):
            streams = self.streams(plan).streams
            terms = sum((each.grid.n_points if each.grid else self.n_directions) * each.fit.n_taps for each in streams)
            n_zones = len(self._zones(plan.focal_zones))
            return TABLE_BYTES * terms * self.n_mics * n_zones + signals * (2 + len(streams)) // 2
        if not plan.delay_taps:
            n_delays = self.n_directions * self.n_mics
            n_rows = rows_at_a_time(self.n_directions, self.window.n_outputs) + self.n_mics
            n_zones = len(self._zones(plan.focal_zones))
            return n_delays * (SHIFT_TABLE_BYTES + SHIFT_BYTES * n_zones) + 8 * n_rows * self.window.n_outputs
        nodes = self.nodes(plan.beam_taps, plan.density) if plan.beam_taps else None
        n_beams = self.n_directions if nodes is None else nodes.count
        if plan.row_beams and self.rows is not None:
            n_row_beams, _ = self._row_counts(plan)
            n_terms = n_row_beams * plan.n_phases * self.rows.rows.most
            n_terms += n_beams * len(self.rows.rows) * (plan.beam_taps if self.rows.is_curved else 1)
            signals += 16 * n_row_beams * plan.n_phases * self.window.n_outputs
            return signals + TABLE_BYTES * n_terms * plan.delay_taps * len(self._zones(plan.focal_zones))
        table = TABLE_BYTES * n_beams * self.n_mics * plan.delay_taps * len(self._zones(plan.focal_zones))
        return table + signals

    @cached_in_instance
    def zone_error(self, count: int) -> float:
        """Return the error power of a given number of focal zones."""
        curvature_2 = squared_curvature(self.window.range_m, self._zones(count))
        return self._zone_scale * curvature_2

    @cached_in_instance
    def _zones(self, count: int) -> list[tuple[int, int, float]]:
        return zones_of(self.settings.replace(accuracy=self.settings.accuracy.replace(focal_zones=count)))

    @functools.cached_property
    def _zone_scale(self) -> float:
        return self.errors.zones(self.aperture, 1.0, sound_speed_m_s=self._speed_m_s)

    @cached_in_instance
    def delays(self, n_phases: int, n_taps: int) -> Delays:
        """Return the prediction for an interpolation of delays."""
        step_s = 1 / (self.settings.output_rate_hz * n_phases)
        fit, weights = fitted(self._spectrum, n_taps, step_s)
        delays_s = self._few_delays(step_s)
        fractions = None if delays_s is None else fit.split(delays_s)[1]
        return Delays(
            n_taps=fit.n_taps,
            error=self.errors.delays(fit, n_mics=self._n_effective, fractions=fractions),
            sum_of_weights=float(np.max(weights.sum(axis=1))),
            squares=float(np.mean(np.sum(weights**2, axis=1))),
        )

    def _few_delays(self, step_s: float) -> NDArray[np.float64] | None:
        return few_delays(self.aperture, self._own_s, self._weights, step_s, sound_speed_m_s=self._speed_m_s)

    def count_grid_points(self, n_taps: int, density: float) -> int:
        """Return the number of beam-grid points."""
        return grid_points(self._beams(n_taps, density))

    def _beams(self, n_taps: int, density: float) -> PlannedBeams:
        high_hz = self.settings.call.high_frequency_hz
        return PlannedBeams(self.aperture, self._spectrum, n_taps, density, high_hz, self._speed_m_s, self._nearest_m)

    @cached_in_instance
    def nodes(self, n_taps: int, density: float) -> Nodes:
        """Return the prediction for a beam grid."""
        require_beam_grid(self.aperture, len(self.window.range_m))
        beams = self._beams(n_taps, density)
        if self.errors.needs_steering and math.isinf(self._nearest_m):
            grid = estimated(beams)
            error, squares = self.errors.beams(grid), grid.squares
        else:
            grid = None
            power, squares = estimated_errors(beams)
            error = self.errors.uniform_beams(power)
        n_pairs = n_taps**self.aperture.n_axes // 2
        return Nodes(self.count_grid_points(n_taps, density), n_pairs, error, squares, grid)

    @cached_in_instance
    def filter(self, stopband_attenuation_db: float) -> tuple[NDArray[Any], float]:
        """Return the taps of a decimation filter, and their error."""
        try:
            taps = chain_taps(self.settings.replace(accuracy=Accuracy(stopband_attenuation_db=stopband_attenuation_db)))
        except ArgumentError:
            if (
                self.settings.accuracy.stopband_attenuation_db is not None
                or stopband_attenuation_db == MIN_STOPBAND_ATTENUATION_DB
            ):
                raise
            return np.ones(1, dtype=np.int16), math.inf
        return taps, self.errors.filter(taps)

    def _whole_numbers(self, delays: Delays, node_squares: float | None, n_summed: int | None = None) -> float:
        """Return the error power of 16 bits; ``node_squares`` is that of `Nodes`, None without a beam grid."""
        n_summed = self.n_mics if n_summed is None else n_summed
        weight_limit, limit = whole_limits(n_summed * delays.sum_of_weights)
        squares = 1.0 if node_squares is None else node_squares
        error = self.errors.samples(
            n_terms=delays.n_taps, terms=delays.squares, limit=limit, weight_limit=weight_limit, taps=squares
        )
        if node_squares is not None:
            filled = limit * weight_limit * n_summed * delays.sum_of_weights / 2**31
            error += self.errors.nodes(n_mics=n_summed, sum_of_terms=delays.sum_of_weights, taps=squares, filled=filled)
        return error

    def _n_bins(self, window: TimeWindow) -> int:
        low_hz, high_hz = matched_band_hz(self.settings)
        return math.ceil((high_hz - low_hz) * window.n_fft / self.settings.signal_rate_hz)

    @cached_in_instance
    def _windows(self, stopband_attenuation_db: float) -> TimeWindow:
        """Return the window of a plan, whose ringing depends on its stopband attenuation."""
        ringing = self._ringing_db(stopband_attenuation_db)
        return time_window(self.settings, largest_delay_s=self._reach_s(), n_taps=1, ringing_db=ringing)

    def _ringing_db(self, stopband_attenuation_db: float) -> float:
        accuracy = self.settings.accuracy.replace(stopband_attenuation_db=stopband_attenuation_db)
        return ringing_db(self.settings.replace(accuracy=accuracy))

    def _reach_s(self) -> float:
        positions_m = self.aperture.square_m2
        return math.sqrt(float(np.max(positions_m, initial=0.0))) / self._speed_m_s


def plan_of(accuracy: Accuracy) -> ImagePlan:
    """Return accuracy settings as a plan; missing values get their defaults."""
    return ImagePlan(
        accuracy.precision,
        accuracy.oversampling or 1,
        1 if accuracy.delay_taps is None else accuracy.delay_taps,
        accuracy.beam_taps or 0,
        accuracy.beam_density or 2.0,
        accuracy.stopband_attenuation_db or 60.0,
        accuracy.focal_zones or 1,
        bool(accuracy.row_beams),
    )
