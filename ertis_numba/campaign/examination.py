"""Predicted and measured error and time of a sensor's plan."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.campaign.attitudes import unlevelled_image
from ertis_numba.chain.error_model import PARTS, ErrorModel, decibels
from ertis_numba.chain.planner import Planner
from ertis_numba.chain.stream_recipe import uses_streams
from ertis_numba.chain.wavefronts import plane_wave_error_db
from ertis_numba.frames import Measurement
from ertis_numba.pipeline import Pipeline, verification
from ertis_numba.pipeline.prediction import planner_of, relative_to_exact_db
from ertis_numba.settings import Settings

__all__ = ["examine"]


def examine(
    pipeline: Pipeline,
    first: Measurement,
    *,
    threads: int | None,
    explain: bool,
    verify: bool,
    heard: Planner | None = None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the examination of a sensor's plan for JSON: ``plan`` with predictions, ``verified`` with the error."""
    settings = pipeline.settings
    if settings.processing.method == "paper":
        raise ArgumentError(
            "explain=True and verify=True need a plan, but method 'paper' has none; use method 'fast', or remove them"
        )
    kernel_set = kernels.load(pipeline.device)
    n_threads = kernel_set.max_threads if threads is None else threads
    planners = {
        # Measured costs give the times on this machine.
        "safe": Planner(settings, kernel_set, threads=n_threads, plan="measured"),
        "signal_model": heard or planner_of(unlevelled_image(pipeline, first), first, kernel_set, threads=n_threads),
    }
    if explain:
        yield "plan", _plan(planners, settings)
    if verify:
        verified = _verified(pipeline, first, planners)
        yield "verified", verified
        _require_budget(first.stamp.sensor, verified["error_db"], settings)


def _plan(planners: dict[str, Planner], settings: Settings) -> dict[str, Any]:
    """Return a plan with its predictions."""
    chosen = {name: planner.chosen(settings.accuracy) for name, planner in planners.items()}
    safe, signal_model = chosen["safe"], chosen["signal_model"]
    return {
        "accuracy": {name: getattr(settings.accuracy, name) for name in settings.accuracy.__struct_fields__},
        "parts": [
            {
                "name": name,
                "due_to": due_to,
                "safe_db": round(decibels(safe.parts[name]), 1),
                "predicted_db": round(decibels(signal_model.parts[name]), 1),
            }
            for name, due_to in PARTS.items()
            if safe.parts[name]
        ],
        "safe_db": round(safe.error_db, 1),
        "predicted_db": round(signal_model.error_db, 1),
        "stages_ms": {name: round(time_ms, 3) for name, time_ms in safe.stages_ms.items()},
        "time_ms": round(safe.time_ms, 3),
        "costs": str(planners["safe"].costs_file),
        "budget_applies_to": planners["safe"].budget_scope(settings.accuracy),
        "streams": uses_streams(settings.processing, settings.accuracy),
        "decimated": settings.recording.is_pdm or settings.decimation != 1,
        "plane_waves": _plane_waves(planners["signal_model"].model, settings),
    }


def _plane_waves(model: ErrorModel, settings: Settings) -> list[dict[str, float]] | None:
    """Return the errors of plane wavefronts at both ends of the range axis; None for spherical wavefronts."""
    if settings.processing.wavefront != "plane":
        return None
    return [
        {
            "range_m": range_m,
            "error_db": round(plane_wave_error_db(model, settings, range_m), 1),
        }
        for range_m in settings.processing.range_m
    ]


def _verified(pipeline: Pipeline, first: Measurement, planners: dict[str, Planner]) -> dict[str, Any]:
    """Return the true error of a measurement, with the predicted errors."""
    accuracy = pipeline.settings.accuracy
    measured = verification.measure(unlevelled_image(pipeline, first), first)
    return {
        "sequence": first.stamp.sequence,
        "directions": measured.n_directions,
        "error_db": round(measured.error_db, 2),
        "predicted_db": round(_predicted_db(pipeline, planners["signal_model"]), 2),
        "safe_db": round(planners["safe"].error_db(accuracy), 2),
        "max_error_db": accuracy.max_error_db,
        "peaks": measured.peaks and {name: _rounded(value) for name, value in asdict(measured.peaks).items()},
    }


def _predicted_db(pipeline: Pipeline, planner: Planner) -> float:
    error_db = planner.error_db(pipeline.settings.accuracy)
    return error_db if pipeline.settings.processing.is_adaptive else relative_to_exact_db(error_db)


def _require_budget(sensor: str, error_db: float, settings: Settings) -> None:
    allowed_db = settings.accuracy.max_error_db
    if not error_db <= allowed_db:
        raise DataError(
            f"image of sensor {sensor} has an error of {error_db:.1f} dB, but the limit is {allowed_db:g} dB; "
            "use a lower max_error_db, or remove keys of [accuracy]"
        )


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
