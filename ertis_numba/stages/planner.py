"""The cheapest plan whose predicted error keeps a budget."""

import functools
import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.errors import ArgumentError
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.kernels import KernelSet
from ertis_numba.settings import INTERPOLATIONS, MOST_ZONES, Accuracy, Settings
from ertis_numba.stages.accuracy import PARTS, ErrorModel, Texture, decibels
from ertis_numba.stages.adaptive import require_order
from ertis_numba.stages.beam_nodes import FEWEST_RANGES, Aperture, BeamNodes, require_nodes
from ertis_numba.stages.beamform import require_int16, whole_limits
from ertis_numba.stages.costs import Costs, Work, cache_file, costs_of
from ertis_numba.stages.fast import ahead_of, chain_taps, spectrum_of, zones_of
from ertis_numba.stages.fitting import DelayFit, Spectrum, one_thread
from ertis_numba.stages.sensitivity import Sensitivity
from ertis_numba.stages.window import time_window
from ertis_numba.stages.zones import NEAREST_M, squared_bend
from ertis_numba.waveform import matched_band_hz

__all__ = ["TABLE_BYTES", "Chosen", "Planner", "complete"]

_PHASES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
_DELAY_TAPS = (1, 2, 3, 4, 5, 6)
_DENSITIES = {2: (1.5, 2.0, 2.5, 3.0, 4.0), 4: (1.25, 1.5, 1.75, 2.0, 2.5, 3.0), 6: (1.75, 2.0, 2.5, 3.0)}
_STOP_BANDS_DB = (40.0, 60.0, 80.0, 100.0, 120.0, 140.0)
_STOP_BANDS = 3  # of them are tried: more damping than that is of no use
_MOST_BYTES = 2**31  # of a plan's signals, and of its delays
TABLE_BYTES = 44  # of a delay and a weight, as they are made and as kernels take them
_ROUNDED = 1 + 1e-9  # a plan must keep the budget that it was chosen for when it is given back
_ROUNDED_DB = 1e-6
_MANY_FRACTIONS = 16  # delays, in steps of samples times microphones, that reach every fraction of a step
_NEEDLESS = 0.02  # share of the budget below which a part is as good as nothing
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


def complete(settings: Settings, kernels: KernelSet, *, threads: int, max_bytes: int | None = None) -> Settings:
    """Return settings whose accuracy leaves nothing open; see `Planner.choose`.

    Raises
    ------
    ArgumentError
        No plan keeps the budget, or the one that is given does not.
    """
    if settings.processing.method == "paper":
        return settings
    return Planner(settings, kernels, threads=threads, max_bytes=max_bytes).choose().settings


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
    max_bytes : int, optional
        Limit on the memory of a plan's signals and delays.
    sensitivity : Sensitivity, optional
        Sensitivity of the beamformer; by default, a safe estimate for any sound.

    Raises
    ------
    DeviceError
        16 bits are asked for, and the device has no dot product for them.
    """

    def __init__(
        self,
        settings: Settings,
        kernels: KernelSet,
        *,
        threads: int,
        texture: Texture | None = None,
        max_bytes: int | None = None,
        sensitivity: Sensitivity | None = None,
    ) -> None:
        self.settings = settings
        self._kernels = kernels
        self._most_bytes = _MOST_BYTES if max_bytes is None else max_bytes
        if settings.accuracy.precision == "int16":
            require_int16(kernels)
        self._threads = threads
        self.model = ErrorModel(settings, texture)
        self._spectrum = spectrum_of(settings)
        layout, grid = microphones(settings.array), direction_grid(settings.processing)
        self._n_mics, self._n_words = int(layout.enabled.sum()), layout.n_words
        if settings.processing.beamformer == "dmas":
            require_order(settings.processing.dmas_order, self._n_mics)
        self._sensitivity = sensitivity or Sensitivity.of(settings.processing, self._n_mics)
        self._own_s = layout.delay_s[layout.enabled]
        self._aperture = Aperture.of(layout.enabled_positions_m, unit_vectors(grid.azimuth_rad, grid.elevation_rad))
        amplitudes = 1 / layout.gain[layout.enabled]
        self._spread = float(np.max(amplitudes**2) / np.mean(amplitudes**2))  # scales suit the largest
        self._n_directions = len(grid)
        self._speed_m_s = sound_speed_m_s(settings.air)
        self._window = time_window(settings, largest_delay_s=self._reach_s(), n_taps=1)
        if settings.accuracy.beam_taps:
            require_nodes(self._aperture, len(self._window.range_m))
        self._delays = functools.cache(self._made_delays)
        self._zones = functools.cache(self._made_zones)
        self._nodes = functools.cache(self._made_nodes)
        self._filter = functools.cache(self._made_filter)

    def choose(self) -> Chosen:
        """Return the cheapest plan that keeps the budget.

        Raises
        ------
        ArgumentError
            None does; the message has the best there is.
        """
        wanted_db = self.settings.accuracy.max_error_db
        allowed = 10 ** (wanted_db / 10) * _ROUNDED
        # Where no plan is exact enough for an adaptive beamformer's image, the best one is taken, and the budget is
        # that of the beams; see `prediction` for the warning.
        budget = self._sensitivity.beams(allowed)
        with one_thread():
            plans = self._open_plans(budget)
            rated = [(plan, self._parts(plan)) for plan in plans if self._fits(plan)]
        if not rated:
            raise ArgumentError(
                "no plan fits into memory; give a later or shorter processing.range_m, fewer directions or "
                "microphones, or less of accuracy.oversampling or accuracy.zones"
            )
        within = [plan for plan, parts in rated if sum(parts.values()) <= budget]
        if within:
            # By the costs of all threads whatever their number now, so that it does not decide about the plan.
            costs = costs_of(self._kernels, self._kernels.max_threads) if len(within) > 1 else None
            cheapest = min(within, key=lambda plan: self._time(plan, costs)) if costs else within[0]
            return self.chosen(self._accuracy(cheapest))
        plan, parts = min(rated, key=lambda entry: sum(entry[1].values()))
        if budget < sum(parts.values()) <= allowed:
            return self.chosen(self._accuracy(plan))
        best = self.chosen(self._accuracy(plan))
        memory = ", others do not fit into memory" if len(rated) < len(plans) else ""
        wider = f"give {math.ceil(best.error_db)} or more, or " if best.error_db <= 0 else ""
        raise ArgumentError(
            f"accuracy.max_error_db is {wanted_db:g}, and the best that these settings can is {best.error_db:.1f} "
            f"({_worst(best)}{memory}); {wider}leave more of [accuracy] open"
        )

    def chosen(self, accuracy: Accuracy) -> Chosen:
        """Return what is expected of a complete plan."""
        stages_ms = costs_of(self._kernels, self._threads).stages_ms(self._work(_plan_of(accuracy)))
        return Chosen(self.settings.replace(accuracy=accuracy), self._image_parts(accuracy), stages_ms)

    def error_db(self, accuracy: Accuracy) -> float:
        """Return the predicted error of the image for a complete plan."""
        return decibels(sum(self._image_parts(accuracy).values()))

    def keeps_budget_of_images(self, accuracy: Accuracy) -> bool:
        """Return False if a complete plan of an adaptive beamformer keeps the budget for delay-and-sum beams only.

        The answer holds for any sound: it depends neither on the texture nor on the sensitivity of this planner.
        """
        if self.settings.processing.beamformer == "delay_and_sum":
            return True
        safe = Planner(self.settings, self._kernels, threads=self._threads)
        return safe.error_db(accuracy) <= accuracy.max_error_db + _ROUNDED_DB

    def _image_parts(self, accuracy: Accuracy) -> dict[str, float]:
        parts = self.parts(accuracy)
        beams = sum(parts.values())
        amplified = self._sensitivity.output(beams) / beams if 0 < beams < math.inf else 1.0
        return {name: amplified * power for name, power in parts.items()}

    def parts(self, accuracy: Accuracy) -> dict[str, float]:
        """Return the error power of each step of a complete plan, relative to the exact image."""
        with one_thread():
            return self._parts(_plan_of(accuracy))

    def _accuracy(self, plan: _Plan) -> Accuracy:
        return self.settings.accuracy.replace(
            precision=plan.precision,
            oversampling=plan.n_phases,
            delay_taps=plan.delay_taps,
            beam_taps=plan.beam_taps,
            beam_density=plan.density,
            stop_band_db=plan.stop_band_db,
            zones=plan.zones,
        )

    def _parts(self, plan: _Plan) -> dict[str, float]:
        """Return the parts of a plan's error."""
        delays = self._delays(plan.n_phases, plan.interpolation, plan.delay_taps)
        nodes = self._nodes(plan.beam_taps, plan.density) if plan.beam_taps else None
        _, filter_error = self._filter(plan.stop_band_db)
        parts = dict.fromkeys(PARTS, 0.0)
        parts["delays"], parts["filter"] = delays.error, filter_error
        parts["arithmetic"] = self.model.arithmetic()
        if nodes is not None:
            parts["beams"] = nodes.error
            parts["delays"] *= max(1.0, nodes.squares)  # weights that nearly cancel add up what their nodes err by
        if self.settings.processing.wavefront == "spherical":
            parts["zones"] = self._zone_error(plan.zones)
        if plan.precision == "int16":
            parts["samples"] = self._whole_numbers(delays, nodes)
        return parts

    def _time(self, plan: _Plan, costs: Costs) -> float:
        return sum(costs.stages_ms(self._work(plan)).values())

    def _work(self, plan: _Plan) -> Work:
        nodes = self._nodes(plan.beam_taps, plan.density) if plan.beam_taps else None
        taps, _ = self._filter(plan.stop_band_db)
        tile = self._kernels.tile_ranges if plan.precision == "int16" else FEWEST_RANGES
        return Work(
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
            n_computed=tile * sum(-(-(stop - first) // tile) for first, stop, _ in self._zones(plan.zones)),
            n_beams=self._n_directions if nodes is None else nodes.count,
            n_terms=self._n_mics * plan.delay_taps,
            n_pairs=0 if nodes is None else nodes.n_pairs,
            precision=plan.precision,
        )

    def _fits(self, plan: _Plan) -> bool:
        """Whether signals, tiles and delays fit into memory."""
        nodes = self._nodes(plan.beam_taps, plan.density) if plan.beam_taps else None
        n_beams = self._n_directions if nodes is None else nodes.count
        table = TABLE_BYTES * n_beams * self._n_mics * plan.delay_taps * len(self._zones(plan.zones))
        return table + 16 * self._n_mics * plan.n_phases * self._window.n_outputs <= self._most_bytes

    def _open_plans(self, budget: float) -> list[_Plan]:
        """Return the plans that the settings leave open and that fit into memory."""
        given = self.settings.accuracy
        adaptive = self.settings.processing.beamformer != "delay_and_sum"
        precisions = ["float32"] if given.precision == "auto" else [given.precision]
        if given.precision == "auto" and self._kernels.tile_ranges and not adaptive:
            precisions.append("int16")
        zones = self._zone_count(budget)
        return [
            _Plan(
                precision,
                n_phases,
                given.interpolation,
                n_taps,
                beam_taps,
                density,
                stop_band_db,
                zones,
            )
            for precision, (n_phases, n_taps), (beam_taps, density), stop_band_db in itertools.product(
                precisions,
                self._open_delays(budget, adaptive=adaptive),
                self._open_nodes(budget, adaptive=adaptive),
                self._stop_bands_db(budget),
            )
        ]

    def _open_delays(self, budget: float, *, adaptive: bool) -> list[tuple[int, int]]:
        """Return which samples and taps are worth a try: those that keep the budget and are not needlessly exact."""
        given = self.settings.accuracy
        phases = _PHASES if given.oversampling is None else (given.oversampling,)
        taps = _DELAY_TAPS if given.delay_taps is None else (given.delay_taps,)
        if INTERPOLATIONS[given.interpolation] or adaptive:
            taps = (INTERPOLATIONS[given.interpolation] or 1,)
        found = []
        for n_taps in taps:
            for n_phases in phases:
                error = self._delays(n_phases, given.interpolation, n_taps).error
                if error <= budget:
                    found.append((n_phases, n_taps))
                if error <= _NEEDLESS * budget:
                    break
        return found or [(phases[-1], n_taps) for n_taps in taps]

    def _open_nodes(self, budget: float, *, adaptive: bool) -> list[tuple[int, float]]:
        """Return which nodes are worth a try, and that every direction's own beam is."""
        given = self.settings.accuracy
        flat = self._aperture.n_axes in {1, 2} and len(self._window.range_m) >= FEWEST_RANGES
        if adaptive or given.beam_taps == 0 or not (flat or given.beam_taps):
            return [(0, given.beam_density or 2.0)]
        found: list[tuple[int, float]] = [] if given.beam_taps else [(0, given.beam_density or 2.0)]
        for beam_taps in [given.beam_taps] if given.beam_taps else _DENSITIES:
            densities = _DENSITIES[beam_taps] if given.beam_density is None else (given.beam_density,)
            for density in densities:  # from the coarsest, which is the cheapest, to those that are needlessly exact
                if not given.beam_taps and self._count_nodes(beam_taps, density) >= self._n_directions:
                    break
                error = self._nodes(beam_taps, density).error
                if error <= budget or given.beam_taps:
                    found.append((beam_taps, density))
                if error <= _NEEDLESS * budget:
                    break
        return found

    def _stop_bands_db(self, budget: float) -> list[float]:
        """Return the stop bands that leave some of the budget to other parts, the best one where none does."""
        if self.settings.accuracy.stop_band_db is not None:
            return [self.settings.accuracy.stop_band_db]
        errors = {stop_band_db: self._filter(stop_band_db)[1] for stop_band_db in _STOP_BANDS_DB}
        enough = [stop_band_db for stop_band_db, error in errors.items() if error < budget]
        return enough[:_STOP_BANDS] or [min(errors, key=lambda stop_band_db: errors[stop_band_db])]

    def _zone_count(self, budget: float) -> int:
        """Return as many zones as keep their part small; it falls with the square of their number."""
        if self.settings.accuracy.zones is not None:
            return self.settings.accuracy.zones
        if self.settings.processing.wavefront == "plane":
            return 1
        count = 1
        while self._zone_error(count) > _SMALL * budget and count < MOST_ZONES:
            count = min(MOST_ZONES, max(count + 1, math.ceil(1.2 * count)))
        return count

    def _made_zones(self, count: int) -> list[tuple[int, int, float]]:
        return zones_of(self.settings.replace(accuracy=self.settings.accuracy.replace(zones=count)))

    def _zone_error(self, count: int) -> float:
        bend_2 = squared_bend(self._window.range_m, self._zones(count))
        return self._zone_scale * bend_2

    @functools.cached_property
    def _zone_scale(self) -> float:
        return self.model.zones(self._aperture, 1.0, sound_speed_m_s=self._speed_m_s)

    def _made_delays(self, n_phases: int, interpolation: str, n_taps: int) -> _Delays:
        step_s = 1 / (self.settings.output_rate_hz * n_phases)
        fit, weights = _fitted(self._spectrum, interpolation, n_taps, step_s)
        return _Delays(
            n_taps=fit.n_taps,
            error=self.model.delays(fit, n_mics=self._n_mics, fractions=self._few_fractions(fit, step_s)),
            sum_of_weights=float(np.max(weights.sum(axis=1))),
            squares=float(np.mean(np.sum(weights**2, axis=1))),
        )

    def _few_fractions(self, fit: DelayFit, step_s: float) -> NDArray[np.float64] | None:
        """Return the fractions of all delays, if the delays are too few to spread evenly over a step."""
        if self._n_mics * (1 + 2 * self._reach_s() / step_s) > _MANY_FRACTIONS:
            return None
        delays_s = (
            self._own_s
            - ahead_of(fit, self._n_mics, step_s)
            + self._aperture.delays_s(self._aperture.directions, sound_speed_m_s=self._speed_m_s, range_m=math.inf)
        )
        return fit.split(delays_s)[1].ravel()

    def _count_nodes(self, n_taps: int, density: float) -> int:
        high_hz = self.settings.call.high_frequency_hz
        spacing = self._aperture.spacing(density, high_hz=high_hz, sound_speed_m_s=self._speed_m_s)
        return self._aperture.count_nodes(spacing, n_taps)

    def _made_nodes(self, n_taps: int, density: float) -> _Nodes:
        require_nodes(self._aperture, len(self._window.range_m))
        nodes = BeamNodes(
            self._aperture,
            self._spectrum,
            n_taps=n_taps,
            density=density,
            high_hz=self.settings.call.high_frequency_hz,
            sound_speed_m_s=self._speed_m_s,
            estimate=True,
            nearest_m=self._nearest_m,
        )
        n_pairs = n_taps**self._aperture.n_axes // 2
        return _Nodes(self._count_nodes(n_taps, density), n_pairs, self.model.beams(nodes), nodes.squares)

    def _made_filter(self, stop_band_db: float) -> tuple[NDArray[Any], float]:
        try:
            taps = chain_taps(self.settings.replace(accuracy=Accuracy(stop_band_db=stop_band_db)))
        except ArgumentError:
            if self.settings.accuracy.stop_band_db is not None or stop_band_db == _STOP_BANDS_DB[0]:
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
        return error * self._spread

    @property
    def costs_file(self) -> Path:
        """Where the costs are kept that predict times; taken away, they are measured again."""
        return cache_file(self._kernels.device, self._threads, self._kernels.hardware)

    @property
    def _nearest_m(self) -> float:
        if self.settings.processing.wavefront == "plane":
            return math.inf
        return max(float(self._window.range_m[0]), NEAREST_M)

    @functools.cached_property
    def _n_bins(self) -> int:
        low_hz, high_hz = matched_band_hz(self.settings)
        return math.ceil((high_hz - low_hz) * self._window.n_fft / self.settings.signal_rate_hz)

    def _reach_s(self) -> float:
        positions_m = self._aperture.square_m2
        return math.sqrt(float(np.max(positions_m, initial=0.0))) / self._speed_m_s


@functools.lru_cache(maxsize=4 * len(_PHASES) * len(_DELAY_TAPS))
def _fitted(spectrum: Spectrum, interpolation: str, n_taps: int, step_s: float) -> tuple[DelayFit, NDArray[np.float64]]:
    """Return a fit and the magnitudes of its weights; kept, as most of a planner's time would go into them."""
    fit = DelayFit(interpolation, n_taps, step_s, spectrum)
    return fit, np.abs(fit.weights(fit.fractions))


def _plan_of(accuracy: Accuracy) -> _Plan:
    """Return a complete plan."""
    return _Plan(
        accuracy.precision,
        accuracy.oversampling or 1,
        accuracy.interpolation,
        accuracy.delay_taps or 1,
        accuracy.beam_taps or 0,
        accuracy.beam_density or 2.0,
        accuracy.stop_band_db or 60.0,
        accuracy.zones or 1,
    )


def _worst(chosen: Chosen) -> str:
    name = max(chosen.parts, key=lambda part: chosen.parts[part])
    return f"{decibels(chosen.parts[name]):.1f} by {PARTS[name]}"
