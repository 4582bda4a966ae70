"""Search space of the planner: the plans that settings permit."""

import itertools
import math

from ertis_numba.settings import INTERPOLATIONS, MAX_FOCAL_ZONES
from ertis_numba.stages.beam_grid import FEWEST_RANGES
from ertis_numba.stages.plan_model import COARSEST_STOP_BAND_DB, ImagePlan, PlanModel

__all__ = ["open_plans"]

_PHASES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
_DELAY_TAPS = (1, 2, 3, 4, 5, 6)
_DENSITIES = {2: (1.5, 2.0, 2.5, 3.0, 4.0), 4: (1.25, 1.5, 1.75, 2.0, 2.5, 3.0), 6: (1.75, 2.0, 2.5, 3.0)}
_STOP_BANDS_DB = (COARSEST_STOP_BAND_DB, 60.0, 80.0, 100.0, 120.0, 140.0)
_STOP_BANDS = 3  # number of candidates; more attenuation brings no benefit
_NEEDLESS = 0.02  # share of the budget below which a part is as good as nothing
_SMALL = 0.1  # share of the budget for parts that cost little to keep small


def open_plans(model: PlanModel, budget: float, *, has_int16: bool) -> list[ImagePlan]:
    """Return the plans that the settings permit, except needlessly exact ones.

    Parameters
    ----------
    model : PlanModel
    budget : float
        Largest error power of a plan.
    has_int16 : bool
        The device has a dot product of 16-bit numbers.
    """
    given = model.settings.accuracy
    adaptive = model.settings.processing.beamformer != "delay_and_sum"
    precisions = ["float32"] if given.precision == "auto" else [given.precision]
    if given.precision == "auto" and has_int16 and not adaptive:
        precisions.append("int16")
    zones = _zone_count(model, budget)
    return [
        ImagePlan(
            precision,
            n_phases,
            given.interpolation,
            n_taps,
            beam_taps,
            density,
            stopband_attenuation_db,
            zones,
        )
        for precision, (n_phases, n_taps), (beam_taps, density), stopband_attenuation_db in itertools.product(
            precisions,
            _open_delays(model, budget, adaptive=adaptive),
            _open_nodes(model, budget, adaptive=adaptive),
            _stop_bands_db(model, budget),
        )
    ]


def _open_delays(model: PlanModel, budget: float, *, adaptive: bool) -> list[tuple[int, int]]:
    """Return which samples and taps are worth a try: those that keep the budget and are not needlessly exact."""
    given = model.settings.accuracy
    phases = _PHASES if given.oversampling is None else (given.oversampling,)
    taps = _DELAY_TAPS if given.delay_taps is None else (given.delay_taps,)
    if INTERPOLATIONS[given.interpolation] or adaptive:
        taps = (INTERPOLATIONS[given.interpolation] or 1,)
    found = []
    for n_taps in taps:
        for n_phases in phases:
            error = model.delays(n_phases, given.interpolation, n_taps).error
            if error <= budget:
                found.append((n_phases, n_taps))
            if error <= _NEEDLESS * budget:
                break
    return found or [(phases[-1], n_taps) for n_taps in taps]


def _open_nodes(model: PlanModel, budget: float, *, adaptive: bool) -> list[tuple[int, float]]:
    """Return which nodes are worth a try, and that every direction's own beam is."""
    given = model.settings.accuracy
    flat = model.aperture.n_axes in {1, 2} and len(model.window.range_m) >= FEWEST_RANGES
    if adaptive or given.beam_taps == 0 or not (flat or given.beam_taps):
        return [(0, given.beam_density or 2.0)]
    found: list[tuple[int, float]] = [] if given.beam_taps else [(0, given.beam_density or 2.0)]
    for beam_taps in [given.beam_taps] if given.beam_taps else _DENSITIES:
        densities = _DENSITIES[beam_taps] if given.beam_density is None else (given.beam_density,)
        for density in densities:  # from the coarsest, which is the cheapest, to those that are needlessly exact
            if not given.beam_taps and model.count_nodes(beam_taps, density) >= model.n_directions:
                break
            error = model.nodes(beam_taps, density).error
            if error <= budget or given.beam_taps:
                found.append((beam_taps, density))
            if error <= _NEEDLESS * budget:
                break
    return found


def _stop_bands_db(model: PlanModel, budget: float) -> list[float]:
    """Return the stop bands that leave some of the budget to other parts, the best one where none does."""
    if model.settings.accuracy.stopband_attenuation_db is not None:
        return [model.settings.accuracy.stopband_attenuation_db]
    errors = {
        stopband_attenuation_db: model.filter(stopband_attenuation_db)[1] for stopband_attenuation_db in _STOP_BANDS_DB
    }
    enough = [stopband_attenuation_db for stopband_attenuation_db, error in errors.items() if error < budget]
    return enough[:_STOP_BANDS] or [min(errors, key=lambda stopband_attenuation_db: errors[stopband_attenuation_db])]


def _zone_count(model: PlanModel, budget: float) -> int:
    """Return as many zones as keep their part small; it falls with the square of their number."""
    if model.settings.accuracy.focal_zones is not None:
        return model.settings.accuracy.focal_zones
    if model.settings.processing.wavefront == "plane":
        return 1
    count = 1
    while model.zone_error(count) > _SMALL * budget and count < MAX_FOCAL_ZONES:
        count = min(MAX_FOCAL_ZONES, max(count + 1, math.ceil(1.2 * count)))
    return count
