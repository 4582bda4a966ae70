"""Planner: the fastest plan whose predicted error keeps the budget."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.costs import PLAN_COSTS, Costs, PlanCosts, cache_file, measured_costs, nominal_costs
from ertis_numba.chain.error_model import PARTS, ErrorModel, SignalModel, decibels
from ertis_numba.chain.interpolation_fit import one_thread
from ertis_numba.chain.memory import available_bytes
from ertis_numba.chain.plan_model import ImagePlan, PlanModel, plan_of
from ertis_numba.chain.plan_search import open_plans
from ertis_numba.chain.sensitivity import Sensitivity
from ertis_numba.chain.wavefronts import with_wavefront
from ertis_numba.geometry.waveform import matched_band_hz
from ertis_numba.kernels import KernelSet
from ertis_numba.settings import Accuracy, Settings
from ertis_numba.settings.beamformers import BEAMFORMERS

__all__ = ["BudgetScope", "Chosen", "Planner", "complete"]

BudgetScope = Literal["image", "echoes", "beams"]
"""Images for which a plan keeps its budget: any, those of echoes, or only the delay-and-sum beams of an image."""

_USUAL_BYTES = (
    2**31
)  # memory of a plan's signals and delays; larger plans are considered only if no other keeps the budget
_ROUNDED = 1 + 1e-9  # tolerance, so that a complete plan keeps the budget that it was chosen for
_ROUNDED_DB = 1e-6


@dataclass(frozen=True, slots=True)
class Chosen:
    """Plan with its predicted times and parts of the error power, relative to the exact image; see `accuracy.PARTS`."""

    settings: Settings
    parts: dict[str, float]
    stages_ms: dict[str, float]

    @property
    def error_db(self) -> float:
        """Predicted error of the image in dB."""
        return decibels(sum(self.parts.values()))

    @property
    def time_ms(self) -> float:
        """Predicted time of one measurement in milliseconds."""
        return sum(self.stages_ms.values())


def complete(
    settings: Settings,
    kernels: KernelSet,
    *,
    threads: int,
    max_bytes: int | None = None,
    plan: PlanCosts = "nominal",
) -> Settings:
    """Return settings with a complete plan and wavefront; see `Planner.choose`."""
    if settings.processing.method == "paper":
        return settings.replace(processing=settings.processing.replace(wavefront="plane"))
    if settings.processing.delay_matrix:  # Only exact delays need no model of the distribution of delays.
        settings = settings.replace(accuracy=settings.accuracy.replace(delay_taps=0))

    def chosen(wanted: Settings) -> Settings:
        return Planner(wanted, kernels, threads=threads, max_bytes=max_bytes, plan=plan).choose().settings

    if settings.processing.wavefront != "auto":
        return chosen(settings)
    plane = settings.replace(processing=settings.processing.replace(wavefront="plane"))
    wanted = with_wavefront(plane, Planner(plane, kernels, threads=threads, max_bytes=max_bytes).model)
    try:
        return chosen(wanted)
    except ArgumentError:
        # Spherical wavefronts need more memory, and those of adaptive beamformers streams, which exclude some plans.
        if wanted == plane:
            raise
        return chosen(plane)


class Planner:
    """Planner for the measurements of one sensor on one device; values that the settings' accuracy fixes are kept."""

    # Signal model and sensitivity are safe for any sound unless passed. `max_bytes` limits signals and delays.

    def __init__(
        self,
        settings: Settings,
        kernels: KernelSet,
        *,
        threads: int,
        signal_model: SignalModel | None = None,
        max_bytes: int | None = None,
        sensitivity: Sensitivity | None = None,
        plan: PlanCosts = "nominal",
    ) -> None:
        checks.choice("plan", plan, PLAN_COSTS)
        self.settings = settings
        self._costs_kind = plan
        self._kernels = kernels
        self._max_bytes = max_bytes
        self._threads = threads
        self._plans = PlanModel(settings, signal_model, tile_ranges=kernels.tile_ranges)
        beamformer = BEAMFORMERS[settings.processing.beamformer]
        beamformer.check(self._plans.n_mics, *beamformer.values(settings.processing))
        self._sensitivity = sensitivity or Sensitivity.of(settings.processing, self._plans.n_mics)

    @property
    def model(self) -> ErrorModel:
        """Error model of the signal chain."""
        return self._plans.errors

    @property
    def n_independent(self) -> float:
        """Number of independent points of an image: those of the band, in as many directions as microphones resolve."""
        low_hz, high_hz = matched_band_hz(self.settings)
        imaged_s = len(self._plans.window.range_m) / self.settings.output_rate_hz
        return max(2.0, imaged_s * (high_hz - low_hz) * min(self._plans.n_directions, self._plans.n_mics))

    def _rated(
        self, plans: Sequence[ImagePlan], sizes: Sequence[int], smallest: int, largest: int
    ) -> list[tuple[ImagePlan, dict[str, float]]]:
        """Return plans that need ``smallest`` to ``largest`` bytes, with the error power of each step."""
        return [
            (plan, self._plans.parts(plan))
            for plan, size in zip(plans, sizes, strict=True)
            if smallest <= size <= largest
        ]

    def choose(self) -> Chosen:
        """Return the fastest plan that keeps the budget; otherwise, the error states the smallest possible one."""
        wanted_db = self.settings.accuracy.max_error_db
        allowed = 10 ** (wanted_db / 10) * _ROUNDED
        # If no plan keeps the budget for images of an adaptive beamformer, the most accurate plan is chosen, and the
        # budget applies to the beams; see `ertis_numba.pipeline.prediction` for the warning.
        budget = self._sensitivity.beams(allowed)
        with one_thread():
            plans = open_plans(self._plans, budget)
            if not plans:
                raise ArgumentError(_no_plan(self.settings))
            sizes = [self._plans.n_bytes(plan) for plan in plans]
            limit = _USUAL_BYTES if self._max_bytes is None else self._max_bytes
            rated = self._rated(plans, sizes, 0, limit)
            within = [plan for plan, parts in rated if sum(parts.values()) <= budget]
            # The usual limit comes first, so that the plan rarely depends on the memory of the machine.
            if not within and self._max_bytes is None and max(sizes) > limit:
                usual, limit = limit, max(limit, available_bytes())
                rated += self._rated(plans, sizes, usual + 1, limit)
                within = [plan for plan, parts in rated if sum(parts.values()) <= budget]
        if not rated:
            measured = self._max_bytes is None and limit > _USUAL_BYTES
            has = "this machine has available" if measured else "the limit is"
            raise ArgumentError(
                f"no plan fits into memory: the smallest needs {min(sizes) / 1e6:.0f} MB, {has} {limit / 1e6:.0f} MB; "
                "shorten processing.range_m or start it at a larger range, use fewer directions or microphones, or "
                "use a lower accuracy.oversampling or accuracy.focal_zones"
            )
        if within:
            # Costs are those of all threads, so that the plan does not depend on the number of threads in use.
            costs = self._costs(self._kernels.max_threads) if len(within) > 1 else None
            cheapest = min(within, key=lambda plan: self._time(plan, costs)) if costs else within[0]
            return self.chosen(self._accuracy(cheapest))
        plan, parts = min(rated, key=lambda entry: sum(entry[1].values()))
        if budget < sum(parts.values()) <= allowed and not self._plans.uses_streams(plan):
            return self.chosen(self._accuracy(plan))
        best = self.chosen(self._accuracy(plan))
        memory = f"; more accurate plans exceed {limit / 1e6:.0f} MB of memory" if len(rated) < len(plans) else ""
        wider = f"use {math.ceil(best.error_db)} or more, or " if best.error_db <= 0 else ""
        raise ArgumentError(
            f"accuracy.max_error_db is {wanted_db:g}, but the smallest error of these settings is {best.error_db:.1f} "
            f"({_worst(best)}{memory}); {wider}remove keys of [accuracy]"
        )

    def chosen(self, accuracy: Accuracy) -> Chosen:
        """Return the predictions for a complete plan."""
        stages_ms = self._costs(self._threads).stages_ms(self._plans.work(plan_of(accuracy)))
        return Chosen(self.settings.replace(accuracy=accuracy), self._image_parts(accuracy), stages_ms)

    def parts(self, accuracy: Accuracy) -> dict[str, float]:
        """Return the error power of each step of a complete plan, relative to the exact image."""
        with one_thread():
            return self._plans.parts(plan_of(accuracy))

    def error_db(self, accuracy: Accuracy) -> float:
        """Return the predicted image error of a complete plan, in decibels."""
        return decibels(sum(self._image_parts(accuracy).values()))

    def budget_scope(self, accuracy: Accuracy) -> BudgetScope:
        """Return the images for which a complete plan keeps its budget before a measurement."""
        if not self.settings.processing.is_adaptive:
            return "image"
        safe, allowed_db = Planner(self.settings, self._kernels, threads=self._threads), accuracy.max_error_db
        if safe.error_db(accuracy) > allowed_db + _ROUNDED_DB:
            return "beams"
        noise_db = decibels(sum(safe._image_parts(accuracy, noise_only=True).values()))
        return "image" if noise_db <= allowed_db + _ROUNDED_DB else "echoes"

    def _image_parts(self, accuracy: Accuracy, *, noise_only: bool = False) -> dict[str, float]:
        with one_thread():
            parts = self._plans.parts(plan_of(accuracy), noise_only=noise_only)
        beams = sum(parts.values())
        amplified = self._sensitivity.output(beams) / beams if 0 < beams < math.inf else 1.0
        return {name: amplified * power for name, power in parts.items()}

    def _accuracy(self, plan: ImagePlan) -> Accuracy:
        return self.settings.accuracy.replace(
            precision=plan.precision,
            oversampling=plan.n_phases,
            delay_taps=plan.delay_taps,
            beam_taps=plan.beam_taps,
            beam_density=plan.density,
            stopband_attenuation_db=plan.stopband_attenuation_db,
            focal_zones=plan.focal_zones,
            row_beams=True if plan.row_beams else self.settings.accuracy.row_beams,
        )

    def _time(self, plan: ImagePlan, costs: Costs) -> float:
        return sum(costs.stages_ms(self._plans.work(plan)).values())

    def _costs(self, threads: int) -> Costs:
        if self._costs_kind == "nominal":
            return nominal_costs(self._kernels)
        return measured_costs(self._kernels, threads)

    @property
    def costs_file(self) -> Path:
        """File with the costs measured on this machine; delete it to measure them again."""
        return cache_file(self._kernels.device, self._threads, self._kernels.hardware)


def _worst(chosen: Chosen) -> str:
    name = max(chosen.parts, key=lambda part: chosen.parts[part])
    return f"{decibels(chosen.parts[name]):.1f} due to {PARTS[name]}"


def _no_plan(settings: Settings) -> str:
    """Return the reason why no plan exists: rows need a beam grid, and spherical wavefronts of others streams."""
    if settings.accuracy.row_beams:
        return (
            "accuracy.row_beams is true, but it needs a beam grid, an image of at least 64 ranges, and an "
            "accuracy.delay_taps of 1 or more; extend processing.range_m, or leave row_beams out"
        )
    return (
        f"processing.beamformer {settings.processing.beamformer!r} with weighting {settings.processing.weighting!r} "
        "needs 16-bit streams for spherical wavefronts, but the accuracy settings exclude them; use "
        "processing.wavefront 'plane', or leave accuracy.precision, delay_taps and beam_taps out"
    )
