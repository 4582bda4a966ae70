"""Time and error of the beamformers and weightings at the default error budget."""

import functools
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from ertis_bench import checks, input_measurements, instruction_sets, machine, timing
from ertis_bench.accuracy import DIRECTIONS, TURN
from ertis_bench.markdown import table
from ertis_numba import kernels
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.pipeline.prediction import planner_of, predict
from ertis_numba.settings.beamformers import BEAMFORMERS, BeamformerName, WeightingName

__all__ = ["FORMS", "form", "run"]

_DMAS_ORDERS: Final = (2, 3, 5)
_MAX_ERROR_DB: Final = -20.0
_WEIGHTED_ORDER: Final = 5  # as in the combination of Jansen, Daems and Steckel (2025)
_FACTOR: Final[WeightingName] = "coherence_factor"


def _combinations() -> list[tuple[BeamformerName, WeightingName, int | None]]:
    """Return beamformer, weighting and order of DMAS of each row, delay-and-sum first."""
    found: list[tuple[BeamformerName, WeightingName, int | None]] = []
    for name in BEAMFORMERS:
        orders = _DMAS_ORDERS if name == "dmas" else (None,)
        found += [(name, "none", order) for order in orders]
        found += [(name, _FACTOR, order) for order in orders if order in {None, _WEIGHTED_ORDER}]
    return found


def run(*, count: int, say: Callable[[str], None], directions: str = DIRECTIONS) -> dict[str, Any]:
    """Measure error and time of each combination on one thread, and return the report."""
    measurement, source = input_measurements.real() or input_measurements.measurement()
    settings = measurement.settings.replace("processing.directions", directions).replace(
        "processing.wavefront", "plane"
    )
    budget_db = settings.accuracy.max_error_db
    kernel_set = kernels.load("cpu")
    rows: list[dict[str, Any]] = []
    calls = {}
    for beamformer, weighting, order in _combinations():
        name = f"{beamformer}, order {order}" if order else beamformer
        say(f"{name}, weighting {weighting}: computing the exact image")
        changes: dict[str, Any] = {"beamformer": beamformer, "weighting": weighting}
        changes |= {"dmas_order": order} if order else {}
        chosen = settings.replace(processing=settings.processing.replace(**changes))
        pipeline = Pipeline(chosen, "cpu", 1, predict=False)
        image = pipeline.process(measurement)
        error_db = verification.measure(image, measurement).error_db
        prediction = predict(planner_of(image, measurement, kernel_set, threads=1))
        predicted_db = prediction.predicted_error_db
        # Images may exceed the budget if `ertis process` warns, but not by much.
        limit_db = min(max(budget_db, predicted_db + prediction.uncertainty_db), _MAX_ERROR_DB)
        checks.require_error(error_db, f"image of {name} with weighting {weighting}", max_error_db=limit_db)
        rows.append({"beamformer": name, "weighting": weighting, "error_db": error_db, "predicted_db": predicted_db})
        out = np.empty_like(image.amplitude)
        calls[f"{name}, {weighting}"] = functools.partial(pipeline.process, measurement, out=out)
    say(f"timing {count} of each")
    times_ms = timing.round_robin(calls, count=count, burst=TURN)
    for row, measured in zip(rows, times_ms.values(), strict=True):
        row.update(timing.summary(measured))
        row["relative_time"] = row["median_ms"] / rows[0]["median_ms"]
    return {
        "machine": machine.describe(),
        "instruction_set": instruction_sets.here(),
        "source": source,
        "count": count,
        "directions": directions,
        "budget_db": budget_db,
        "rows": rows,
    }


def form(report: dict[str, Any]) -> str:
    """Return one row per combination, and the conditions of the measurement."""
    rows = [
        [
            f"`{name}`{comma}{order}",
            f"`{row['weighting']}`",
            *(f"{row[key]:.1f}" for key in ("relative_time", "error_db", "predicted_db")),
        ]
        for row in report["rows"]
        for name, comma, order in [row["beamformer"].partition(",")]
    ]
    head = ["beamformer", "weighting", "time / time of `delay_and_sum`", "error, dB", "predicted, dB"]
    conditions = (
        f"Medians of {report['count']} measurements ({report['source']}) in turns of {TURN}, on one thread with "
        f"{report['instruction_set']}: from the words in memory to an image of {report['directions']} directions, with "
        f"an error budget of {report['budget_db']:g} dB. Errors are relative to the exact image, and were measured "
        "before the times. Predicted: as `ertis process` reports it."
    )
    return "\n\n".join([table(head, rows), f"Measured on {machine.sentence(report['machine'])}", conditions])


FORMS = {"beamformers": form}
"""Forms of the table, by the name in its markers."""
