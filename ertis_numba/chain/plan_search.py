"""Search space of the planner: the plans that settings permit."""

import itertools
import math

from ertis_numba.chain.beam_grid import FEWEST_RANGES
from ertis_numba.chain.plan_model import MIN_STOPBAND_ATTENUATION_DB, ImagePlan, PlanModel
from ertis_numba.chain.stream_plan import GRID_DENSITIES
from ertis_numba.settings import MAX_FOCAL_ZONES, Accuracy, Settings

__all__ = ["open_plans"]

_PHASES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
_DELAY_TAPS = (1, 2, 3, 4, 5, 6)
_STREAM_TAPS = (1, 2, 3, 4)  # Streams are not smooth enough for more.
_STOPBAND_ATTENUATIONS_DB = (MIN_STOPBAND_ATTENUATION_DB, 60.0, 80.0, 100.0, 120.0, 140.0)
_N_STOPBAND_ATTENUATIONS = 3  # Number of candidates; more attenuation brings no benefit.
_NEEDLESS = 0.02  # Share of the budget below which the error of a step is negligible.
_FEWEST_FOR_ROWS = 64  # Smaller arrays gain nothing.
_SMALL = 0.1  # Share of the budget for steps whose error costs little to reduce.


def open_plans(model: PlanModel, budget: float) -> list[ImagePlan]:
    """Return the plans that the settings permit, except needlessly accurate ones; ``budget`` is their error power."""
    given = model.settings.accuracy
    adaptive = model.settings.processing.is_adaptive
    if adaptive and model.settings.processing.wavefront == "spherical":
        return _open_streams(model, budget)
    precisions = ["float32"] if given.precision == "auto" else [given.precision]
    if given.precision == "auto" and not adaptive:
        precisions.append("int16")
    zones = _zone_count(model, budget)
    plans = (
        []
        if given.delay_taps == 0 or (adaptive and not _may_be_plain(given))
        else [
            ImagePlan(precision, n_phases, n_taps, beam_taps, density, stopband_attenuation_db, zones)
            for precision, (n_phases, n_taps), (beam_taps, density), stopband_attenuation_db in itertools.product(
                precisions,
                _open_delays(model, budget, adaptive=adaptive),
                _open_nodes(model, budget, adaptive=adaptive),
                _stop_bands_db(model, budget),
            )
        ]
    )
    if adaptive:
        return plans + _open_streams(model, budget)
    rows = _open_rows(model, budget, zones)
    if given.row_beams:
        return rows
    return (
        plans
        + rows
        + [
            ImagePlan("float32", 1, 0, 0, given.beam_density or 2.0, stopband_attenuation_db, zones)
            for stopband_attenuation_db in (_stop_bands_db(model, budget) if _may_be_shifted(model.settings) else ())
        ]
    )


def _open_rows(model: PlanModel, budget: float, zones: int) -> list[ImagePlan]:
    """Return the candidates that sum the beams of rows first."""
    given = model.settings.accuracy
    fixed = (given.oversampling, given.delay_taps, given.beam_taps, given.stopband_attenuation_db)
    # A complete plan of earlier versions has no rows.
    if given.row_beams is None and (model.n_mics < _FEWEST_FOR_ROWS or None not in fixed):
        return []
    if model.rows is None or given.row_beams is False or given.precision == "float32" or 0 in fixed:
        return []
    return [
        ImagePlan("int16", n_phases, n_taps, beam_taps, density, stopband_attenuation_db, zones, row_beams=True)
        for (n_phases, n_taps), (beam_taps, density), stopband_attenuation_db in itertools.product(
            _open_delays(model, budget, adaptive=False),
            _open_nodes(model, budget, adaptive=False, most=math.inf),
            _stop_bands_db(model, budget),
        )
        if beam_taps
    ]


def _may_be_shifted(settings: Settings) -> bool:
    """Return True if phase shifts of spectra are permitted and may be fastest, as with plane wavefronts."""
    given = settings.accuracy
    if given.delay_taps is None and settings.processing.wavefront == "spherical":
        return False
    is_direct = given.precision != "int16" and given.oversampling in {None, 1} and not given.beam_taps
    return is_direct and given.delay_taps in {None, 0}


def _may_be_plain(given: Accuracy) -> bool:
    """Return True if the kernels of all microphones can keep the given parts of a plan."""
    return given.precision != "int16" and given.delay_taps in {None, 1} and not given.beam_taps


def _open_streams(model: PlanModel, budget: float) -> list[ImagePlan]:
    """Return the candidates that compute an adaptive beamformer from streams."""
    given = model.settings.accuracy
    complete = _may_be_plain(given) and None not in {given.oversampling, given.delay_taps, given.beam_taps}
    if not model.has_streams or given.precision == "float32" or complete:
        return []
    zones, stop_bands_db = _zone_count(model, budget), _stop_bands_db(model, budget)
    found: list[ImagePlan] = []
    for n_taps in _STREAM_TAPS if given.delay_taps is None else (given.delay_taps,):
        phases = _PHASES if given.oversampling is None else (given.oversampling,)
        for n_phases in phases:
            direct = ImagePlan("int16", n_phases, n_taps, 0, given.beam_density or 2.0, stop_bands_db[0], zones)
            error = model.parts(direct)["delays"]
            if error <= budget or len(phases) == 1:
                found += [
                    direct._replace(beam_taps=beam_taps, density=density, stopband_attenuation_db=stop_band_db)
                    for (beam_taps, density), stop_band_db in itertools.product(
                        _stream_grids(model, budget, direct), stop_bands_db
                    )
                ]
            if error <= _NEEDLESS * budget:
                break
    # The last candidate has the smallest error, which the planner then reports.
    return found or [direct._replace(beam_taps=given.beam_taps or 0)]


def _stream_grids(model: PlanModel, budget: float, direct: ImagePlan) -> list[tuple[int, float]]:
    """Return the candidates for the beam grids of streams; 0 taps stand for one beam per direction."""
    given = model.settings.accuracy
    found: list[tuple[int, float]] = [] if given.beam_taps else [(0, direct.density)]
    flat = model.aperture.supports_grid and len(model.window.range_m) >= FEWEST_RANGES
    if given.beam_taps == 0 or not (flat or given.beam_taps):
        return found
    for beam_taps in [given.beam_taps] if given.beam_taps else GRID_DENSITIES:
        densities = GRID_DENSITIES[beam_taps] if given.beam_density is None else (given.beam_density,)
        for density in densities:
            plan = direct._replace(beam_taps=beam_taps, density=density)
            if not given.beam_taps and not any(each.grid for each in model.streams(plan).streams):
                break
            error = model.parts(plan)["beams"]
            if error <= budget or given.beam_taps:
                found.append((beam_taps, density))
            if error <= _SMALL * budget:
                break
    return found


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


def _open_nodes(
    model: PlanModel, budget: float, *, adaptive: bool, most: float | None = None
) -> list[tuple[int, float]]:
    """Return the candidates for beam taps and density of the beam grid; 0 taps stand for one beam per direction."""
    given = model.settings.accuracy
    most = model.n_directions if most is None else most
    flat = model.aperture.supports_grid and len(model.window.range_m) >= FEWEST_RANGES
    if adaptive or given.beam_taps == 0 or not (flat or given.beam_taps):
        return [(0, given.beam_density or 2.0)]
    found: list[tuple[int, float]] = [] if given.beam_taps else [(0, given.beam_density or 2.0)]
    for beam_taps in [given.beam_taps] if given.beam_taps else GRID_DENSITIES:
        densities = GRID_DENSITIES[beam_taps] if given.beam_density is None else (given.beam_density,)
        for density in densities:  # The coarsest grid is the cheapest. The loop ends at needlessly accurate ones.
            if not given.beam_taps and model.count_grid_points(beam_taps, density) >= most:
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
