"""Search space of the planner: the plans that settings permit."""

import itertools
import math

from ertis_numba.settings import MAX_FOCAL_ZONES
from ertis_numba.stages.beam_grid import FEWEST_RANGES
from ertis_numba.stages.plan_model import MIN_STOPBAND_ATTENUATION_DB, ImagePlan, PlanModel

__all__ = ["open_plans"]

_PHASES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
_DELAY_TAPS = (1, 2, 3, 4, 5, 6)
_DENSITIES = {2: (1.5, 2.0, 2.5, 3.0, 4.0), 4: (1.25, 1.5, 1.75, 2.0, 2.5, 3.0), 6: (1.75, 2.0, 2.5, 3.0)}
_STOPBAND_ATTENUATIONS_DB = (MIN_STOPBAND_ATTENUATION_DB, 60.0, 80.0, 100.0, 120.0, 140.0)
_N_STOPBAND_ATTENUATIONS = 3  # Number of candidates; more attenuation brings no benefit.
_NEEDLESS = 0.02  # Share of the budget below which the error of a step is negligible.
_SMALL = 0.1  # Share of the budget for steps whose error costs little to reduce.


def open_plans(model: PlanModel, budget: float) -> list[ImagePlan]:
    """Return the plans that the settings permit, except needlessly accurate ones.

    Parameters
    ----------
    model : PlanModel
    budget : float
        Largest error power of a plan, relative to the exact image.
    """
    given = model.settings.accuracy
    adaptive = model.settings.processing.beamformer != "delay_and_sum"
    precisions = ["float32"] if given.precision == "auto" else [given.precision]
    if given.precision == "auto" and not adaptive:
        precisions.append("int16")
    zones = _zone_count(model, budget)
    return [
        ImagePlan(precision, n_phases, n_taps, beam_taps, density, stopband_attenuation_db, zones)
        for precision, (n_phases, n_taps), (beam_taps, density), stopband_attenuation_db in itertools.product(
            precisions,
            _open_delays(model, budget, adaptive=adaptive),
            _open_nodes(model, budget, adaptive=adaptive),
            _stop_bands_db(model, budget),
        )
    ]


def _open_delays(model: PlanModel, budget: float, *, adaptive: bool) -> list[tuple[int, int]]:
    """Return the candidates for phases and delay taps that meet the budget and are not needlessly accurate."""
    given = model.settings.accuracy
    phases = _PHASES if given.oversampling is None else (given.oversampling,)
    taps = (1,) if adaptive else _DELAY_TAPS if given.delay_taps is None else (given.delay_taps,)
    found = []
    for n_taps in taps:
        for n_phases in phases:
            error = model.delays(n_phases, n_taps).error
            if error <= budget:
                found.append((n_phases, n_taps))
            if error <= _NEEDLESS * budget:
                break
    return found or [(phases[-1], n_taps) for n_taps in taps]


def _open_nodes(model: PlanModel, budget: float, *, adaptive: bool) -> list[tuple[int, float]]:
    """Return the candidates for beam taps and density of the beam grid; 0 taps stand for one beam per direction."""
    given = model.settings.accuracy
    flat = model.aperture.n_axes in {1, 2} and len(model.window.range_m) >= FEWEST_RANGES
    if adaptive or given.beam_taps == 0 or not (flat or given.beam_taps):
        return [(0, given.beam_density or 2.0)]
    found: list[tuple[int, float]] = [] if given.beam_taps else [(0, given.beam_density or 2.0)]
    for beam_taps in [given.beam_taps] if given.beam_taps else _DENSITIES:
        densities = _DENSITIES[beam_taps] if given.beam_density is None else (given.beam_density,)
        for density in densities:  # The coarsest grid is the cheapest. The loop ends at needlessly accurate ones.
            if not given.beam_taps and model.count_grid_points(beam_taps, density) >= model.n_directions:
                break
            error = model.nodes(beam_taps, density).error
            if error <= budget or given.beam_taps:
                found.append((beam_taps, density))
            if error <= _NEEDLESS * budget:
                break
    return found


def _stop_bands_db(model: PlanModel, budget: float) -> list[float]:
    """Return the stopband attenuations whose error is below the budget, or the best one if there are none."""
    if model.settings.accuracy.stopband_attenuation_db is not None:
        return [model.settings.accuracy.stopband_attenuation_db]
    errors = {attenuation_db: model.filter(attenuation_db)[1] for attenuation_db in _STOPBAND_ATTENUATIONS_DB}
    enough = [attenuation_db for attenuation_db, error in errors.items() if error < budget]
    return enough[:_N_STOPBAND_ATTENUATIONS] or [min(errors, key=errors.__getitem__)]


def _zone_count(model: PlanModel, budget: float) -> int:
    """Return the number of focal zones that keeps their error small; the error falls with the square of the number."""
    if model.settings.accuracy.focal_zones is not None:
        return model.settings.accuracy.focal_zones
    if model.settings.processing.wavefront == "plane":
        return 1
    count = 1
    while model.zone_error(count) > _SMALL * budget and count < MAX_FOCAL_ZONES:
        count = min(MAX_FOCAL_ZONES, max(count + 1, math.ceil(1.2 * count)))
    return count
