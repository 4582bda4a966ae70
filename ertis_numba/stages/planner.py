"""The cheapest plan whose predicted error keeps a budget."""

import functools
import itertools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.errors import ArgumentError
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.kernels import KernelSet
from ertis_numba.settings import INTERPOLATIONS, Accuracy, Settings
from ertis_numba.stages.accuracy import PARTS, ErrorModel, Texture, decibels
from ertis_numba.stages.beam_nodes import FEWEST_RANGES, Aperture, BeamNodes, require_nodes
from ertis_numba.stages.beamform import require_int16, whole_limits
from ertis_numba.stages.costs import Costs, Work, costs_of
from ertis_numba.stages.fast import chain_taps, spectrum_of
from ertis_numba.stages.fitting import DelayFit, Spectrum, one_thread
from ertis_numba.stages.window import time_window
from ertis_numba.waveform import matched_band_hz

__all__ = ["Chosen", "Planner", "complete", "is_complete"]

_PHASES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
_DELAY_TAPS = (1, 2, 3, 4, 5, 6)
_DENSITIES = {2: (1.5, 2.0, 2.5, 3.0, 4.0), 4: (1.25, 1.5, 1.75, 2.0, 2.5, 3.0), 6: (1.75, 2.0, 2.5, 3.0)}
_STOP_BANDS_DB = (40.0, 60.0, 80.0, 100.0, 120.0, 140.0)
_STOP_BANDS = 3  # of them are tried: more damping than that is of no use
_MOST_BYTES = 2**31  # of a plan's signals, and of its delays
_ROUNDED = 1 + 1e-9  # a plan must keep the budget that it was chosen for when it is given back
_SMALL = 0.1  # share of the budget for parts that cost little to keep small


@dataclass(frozen=True, slots=True)
class Chosen:
    """A plan, and what is expected of it.

    Attributes
    ----------
    settings : Settings
        Their accuracy leaves nothing open.
    parts : dict of str to float
        Power of each part of the error by that of the exact image; see `accuracy.PARTS`.
    stages_ms : dict of str to float
    """

    settings: Settings
    parts: dict[str, float]
    stages_ms: dict[str, float]

    @property
    def error_db(self) -> float:
        """Predicted error of the image."""
        return decibels(sum(self.parts.values()))

    @property
    def time_ms(self) -> float:
        """Predicted time of one measurement."""
        return sum(self.stages_ms.values())


class _Plan(NamedTuple):
    """A complete plan."""

    precision: str
    n_phases: int
    interpolation: str
    delay_taps: int
    beam_taps: int
    density: float
    stop_band_db: float
    zones: int


@dataclass(frozen=True, slots=True)
class _Nodes:
    """What a choice of nodes means: how many, their errors, and the sum of a beam's squared weights."""

    count: int
    n_pairs: int
    error: float
    squares: float


@dataclass(frozen=True, slots=True)
class _Delays:
    """What a choice of samples means."""

    n_taps: int
    error: float
    sum_of_weights: float
    squares: float


def is_complete(accuracy: Accuracy) -> bool:
    """Whether a plan leaves nothing open."""
    return accuracy.precision != "auto" and None not in (
        accuracy.oversampling,
        accuracy.delay_taps,
        accuracy.beam_taps,
        accuracy.beam_density,
        accuracy.stop_band_db,
        accuracy.zones,
    )


def complete(settings: Settings, kernels: KernelSet, *, threads: int) -> Settings:
    """Return settings whose accuracy leaves nothing open; see `Planner.choose`.

    Raises
    ------
    ArgumentError
        No plan keeps the budget, or the one that is given does not.
    """
    if settings.processing.method == "paper":
        return settings
    return Planner(settings, kernels, threads=threads).choose().settings


class Planner:
    """Plans for one kind of measurement on one device.

    Parameters
    ----------
    settings : Settings
        What their accuracy does not leave open is kept to.
    kernels : KernelSet
    threads : int
    texture : Texture, optional
        Of what is heard; what errs on the safe side by default.

    Raises
    ------
    DeviceError
        16 bits are asked for, and the device has no dot product for them.
    """

    def __init__(self, settings: Settings, kernels: KernelSet, *, threads: int, texture: Texture | None = None) -> None:
        self._settings, self._kernels = settings, kernels
        if settings.accuracy.precision == "int16":
            require_int16(kernels)
        self._costs: Costs = costs_of(kernels, threads)
        self.model = ErrorModel(settings, texture)
        self._spectrum = spectrum_of(settings)
        layout, grid = microphones(settings.array), direction_grid(settings.processing)
        self._n_mics, self._n_words = int(layout.enabled.sum()), layout.n_words
        self._aperture = Aperture.of(layout.enabled_positions_m, unit_vectors(grid.azimuth_rad, grid.elevation_rad))
        self._n_directions = len(grid)
        self._speed_m_s = sound_speed_m_s(settings.air)
        self._window = time_window(settings, largest_delay_s=self._reach_s(), n_taps=1)
        if settings.accuracy.beam_taps:
            require_nodes(self._aperture, len(self._window.range_m))
        self._delays = functools.cache(self._made_delays)
        self._nodes = functools.cache(self._made_nodes)
        self._filter = functools.cache(self._made_filter)

    def choose(self) -> Chosen:
        """Return the cheapest plan that keeps the budget.

        Raises
        ------
        ArgumentError
            None does; the message has the best there is.
        """
        wanted_db = self._settings.accuracy.max_error_db
        budget = 10 ** (wanted_db / 10) * _ROUNDED
        with one_thread():
            rated = [(plan, *self._rate(plan)) for plan in self._open_plans(budget)]
        if not rated:
            raise ArgumentError(
                "no plan fits into memory; give a shorter processing.range_m, fewer microphones or less oversampling"
            )
        within = [entry for entry in rated if sum(entry[1].values()) <= budget]
        if within:
            plan, _, _ = min(within, key=lambda entry: sum(entry[2].values()))
            return self.chosen(self._accuracy(plan))
        plan, _, _ = min(rated, key=lambda entry: sum(entry[1].values()))
        best = self.chosen(self._accuracy(plan))
        raise ArgumentError(
            f"accuracy.max_error_db is {wanted_db:g}, and the best that these settings can is {best.error_db:.1f} "
            f"({_worst(best)}); give {math.ceil(best.error_db)} or more, or leave more of [accuracy] open"
        )

    def chosen(self, accuracy: Accuracy) -> Chosen:
        """Return what is expected of a complete plan."""
        plan = _Plan(
            accuracy.precision,
            accuracy.oversampling or 1,
            accuracy.interpolation,
            accuracy.delay_taps or 1,
            accuracy.beam_taps or 0,
            accuracy.beam_density or 2.0,
            accuracy.stop_band_db or 60.0,
            accuracy.zones or 1,
        )
        return Chosen(self._settings.replace(accuracy=accuracy), *self._rate(plan))

    def _accuracy(self, plan: _Plan) -> Accuracy:
        return self._settings.accuracy.replace(
            precision=plan.precision,
            oversampling=plan.n_phases,
            delay_taps=plan.delay_taps,
            beam_taps=plan.beam_taps,
            beam_density=plan.density,
            stop_band_db=plan.stop_band_db,
            zones=plan.zones,
        )

    def _rate(self, plan: _Plan) -> tuple[dict[str, float], dict[str, float]]:
        """Return the parts of a plan's error and what its stages take, in milliseconds."""
        delays = self._delays(plan.n_phases, plan.interpolation, plan.delay_taps)
        nodes = self._nodes(plan.beam_taps, plan.density) if plan.beam_taps else None
        taps, filter_error = self._filter(plan.stop_band_db)
        parts = dict.fromkeys(PARTS, 0.0)
        parts["delays"], parts["filter"] = delays.error, filter_error
        parts["arithmetic"] = self.model.arithmetic()
        if nodes is not None:
            parts["beams"] = nodes.error
            parts["delays"] *= max(1.0, nodes.squares)  # weights that nearly cancel add up what their nodes err by
        if self._settings.processing.wavefront == "spherical":
            parts["zones"] = 0.0 if plan.zones >= len(self._window.range_m) else self._one_zone / plan.zones**2
        if plan.precision == "int16":
            parts["samples"] = self._whole_numbers(delays, nodes)
        work = Work(
            n_mics=self._n_mics,
            n_words=self._n_words,
            n_samples=self._window.n_samples,
            n_taps=len(taps),
            tap_bits=8 * taps.dtype.itemsize,
            n_fft=self._window.n_fft,
            n_bins=self._n_bins,
            n_phases=plan.n_phases,
            n_outputs=self._window.n_outputs,
            n_directions=self._n_directions,
            n_ranges=len(self._window.range_m),
            n_beams=self._n_directions if nodes is None else nodes.count,
            n_terms=self._n_mics * plan.delay_taps,
            n_pairs=0 if nodes is None else nodes.n_pairs,
            precision=plan.precision,
        )
        return parts, self._costs.stages_ms(work)

    def _open_plans(self, budget: float) -> list[_Plan]:
        """Return the plans that the settings leave open and that fit into memory."""
        given = self._settings.accuracy
        adaptive = self._settings.processing.beamformer != "delay_and_sum"
        precisions = ["float32"] if given.precision == "auto" else [given.precision]
        if given.precision == "auto" and self._kernels.tile_ranges and not adaptive:
            precisions.append("int16")
        phases = _PHASES if given.oversampling is None else (given.oversampling,)
        taps = _DELAY_TAPS if given.delay_taps is None else (given.delay_taps,)
        if INTERPOLATIONS[given.interpolation] or adaptive:
            taps = (INTERPOLATIONS[given.interpolation] or 1,)
        bytes_per_phase = 8 * self._n_mics * self._window.n_outputs
        return [
            _Plan(
                precision,
                n_phases,
                given.interpolation,
                n_taps,
                beam_taps,
                density,
                stop_band_db,
                self._zone_count(budget),
            )
            for precision, n_phases, n_taps, (beam_taps, density), stop_band_db in itertools.product(
                precisions, phases, taps, self._open_nodes(budget, adaptive=adaptive), self._stop_bands_db(budget)
            )
            if n_phases * bytes_per_phase <= _MOST_BYTES
            and self._table_bytes(n_taps, beam_taps, density) * self._zone_count(budget) <= _MOST_BYTES
        ]

    def _table_bytes(self, n_taps: int, beam_taps: int, density: float) -> int:
        """Return the size of a zone's delays and weights."""
        nodes = self._nodes(beam_taps, density) if beam_taps else None
        return 12 * (self._n_directions if nodes is None else nodes.count) * self._n_mics * n_taps

    def _open_nodes(self, budget: float, *, adaptive: bool) -> list[tuple[int, float]]:
        """Return which nodes are worth a try, and that every direction's own beam is."""
        given = self._settings.accuracy
        flat = self._aperture.n_axes in {1, 2} and len(self._window.range_m) >= FEWEST_RANGES
        if adaptive or given.beam_taps == 0 or not (flat or given.beam_taps):
            return [(0, given.beam_density or 2.0)]
        found: list[tuple[int, float]] = [] if given.beam_taps else [(0, given.beam_density or 2.0)]
        for beam_taps in [given.beam_taps] if given.beam_taps else _DENSITIES:
            densities = _DENSITIES[beam_taps] if given.beam_density is None else (given.beam_density,)
            for density in reversed(densities):  # the coarser, the cheaper, until they err too much
                if not given.beam_taps and self._count_nodes(beam_taps, density) >= self._n_directions:
                    continue
                nodes = self._nodes(beam_taps, density)
                if nodes.error > budget and not given.beam_taps:
                    break
                found.append((beam_taps, density))
        return found

    def _stop_bands_db(self, budget: float) -> list[float]:
        """Return the stop bands that leave some of the budget to other parts, the best one where none does."""
        if self._settings.accuracy.stop_band_db is not None:
            return [self._settings.accuracy.stop_band_db]
        errors = {stop_band_db: self._filter(stop_band_db)[1] for stop_band_db in _STOP_BANDS_DB}
        enough = [stop_band_db for stop_band_db, error in errors.items() if error < budget]
        return enough[:_STOP_BANDS] or [min(errors, key=lambda stop_band_db: errors[stop_band_db])]

    def _zone_count(self, budget: float) -> int:
        """Return as many zones as keep their part small; it falls with the square of their number."""
        if self._settings.accuracy.zones is not None:
            return self._settings.accuracy.zones
        if self._settings.processing.wavefront == "plane":
            return 1
        wanted = math.ceil(math.sqrt(self._one_zone / (_SMALL * budget)))
        return min(len(self._window.range_m), max(1, wanted))

    @functools.cached_property
    def _one_zone(self) -> float:
        return self.model.zones(self._aperture, self._window.range_m, 1, sound_speed_m_s=self._speed_m_s)

    def _made_delays(self, n_phases: int, interpolation: str, n_taps: int) -> _Delays:
        step_s = 1 / (self._settings.output_rate_hz * n_phases)
        fit, weights = _fitted(self._spectrum, interpolation, n_taps, step_s)
        return _Delays(
            n_taps=fit.n_taps,
            error=self.model.delays(fit),
            sum_of_weights=float(np.max(weights.sum(axis=1))),
            squares=float(np.mean(np.sum(weights**2, axis=1))),
        )

    def _count_nodes(self, n_taps: int, density: float) -> int:
        high_hz = self._settings.call.high_frequency_hz
        spacing = self._aperture.spacing(density, high_hz=high_hz, sound_speed_m_s=self._speed_m_s)
        return self._aperture.count_nodes(spacing, n_taps)

    def _made_nodes(self, n_taps: int, density: float) -> _Nodes:
        require_nodes(self._aperture, len(self._window.range_m))
        nodes = BeamNodes(
            self._aperture,
            self._spectrum,
            n_taps=n_taps,
            density=density,
            high_hz=self._settings.call.high_frequency_hz,
            sound_speed_m_s=self._speed_m_s,
            estimate=True,
        )
        n_pairs = n_taps**self._aperture.n_axes // 2
        return _Nodes(self._count_nodes(n_taps, density), n_pairs, self.model.beams(nodes), nodes.squares)

    def _made_filter(self, stop_band_db: float) -> tuple[NDArray[Any], float]:
        try:
            taps = chain_taps(self._settings.replace(accuracy=Accuracy(stop_band_db=stop_band_db)))
        except ArgumentError:
            if self._settings.accuracy.stop_band_db is not None or stop_band_db == _STOP_BANDS_DB[0]:
                raise
            return np.ones(1, dtype=np.int16), math.inf
        return taps, self.model.filter(taps)

    def _whole_numbers(self, delays: _Delays, nodes: _Nodes | None) -> float:
        weight_limit, limit = whole_limits(self._n_mics * delays.sum_of_weights)
        squares = 1.0 if nodes is None else nodes.squares
        error = self.model.samples(
            n_terms=delays.n_taps, terms=delays.squares, limit=limit, weight_limit=weight_limit, taps=squares
        )
        if nodes is not None:
            filled = limit * weight_limit * self._n_mics * delays.sum_of_weights / 2**31
            error += self.model.nodes(
                n_mics=self._n_mics, sum_of_terms=delays.sum_of_weights, taps=squares, filled=filled
            )
        return error

    @functools.cached_property
    def _n_bins(self) -> int:
        low_hz, high_hz = matched_band_hz(self._settings.call)
        return math.ceil((high_hz - low_hz) * self._window.n_fft / self._settings.signal_rate_hz)

    def _reach_s(self) -> float:
        positions_m = self._aperture.square_m2
        return math.sqrt(float(np.max(positions_m, initial=0.0))) / self._speed_m_s


@functools.lru_cache(maxsize=4 * len(_PHASES) * len(_DELAY_TAPS))
def _fitted(spectrum: Spectrum, interpolation: str, n_taps: int, step_s: float) -> tuple[DelayFit, NDArray[np.float64]]:
    """Return a fit and the magnitudes of its weights; kept, as most of a planner's time would go into them."""
    fit = DelayFit(interpolation, n_taps, step_s, spectrum)
    return fit, np.abs(fit.weights(fit.fractions))


def _worst(chosen: Chosen) -> str:
    name = max(chosen.parts, key=lambda part: chosen.parts[part])
    return f"{decibels(chosen.parts[name]):.1f} by {PARTS[name]}"
