"""What a plan is, what it is expected to err by and to take, and what it does err by."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.frames import Measurement
    from ertis_numba.kernels import KernelSet
    from ertis_numba.pipeline import Pipeline
    from ertis_numba.settings import Settings
    from ertis_numba.stages.accuracy import ErrorModel

__all__ = ["require_plan", "tell"]

_INTERPOLATIONS = {
    "fitted": "made of {n} of them by weights that err least",
    "nearest": "the nearest of them",
    "carrier": "the nearest of them, its carrier turned to the right phase",
    "linear": "made of two of them along a straight line",
    "cubic": "made of four of them along Lagrange's cubic",
}
_NEAREST_M = 1e-3  # where range 0 is meant
_LEAST_MS = 0.005
_PART = "  {name:52}  {safe:>8}  {texture:>14}"


def require_plan(settings: "Settings", *, explain: bool, verify: bool, max_error_db: float | None) -> None:
    """Refuse what only plans have where there is none, or where its error is no sum's."""
    asked = {"--explain": explain, "--verify": verify, "--max-error": max_error_db is not None}
    context = click.get_current_context()
    for name, given in asked.items():
        if given and settings.processing.method == "paper":
            raise click.UsageError(f"{name} is for --method fast; the paper's method has no plan", context)
    if verify and settings.processing.beamformer != "delay_and_sum":
        raise click.UsageError(
            f"--verify knows the exact image of delay_and_sum only, not of {settings.processing.beamformer}", context
        )


def tell(
    pipeline: "Pipeline",
    first: "Measurement",
    *,
    threads: int | None,
    explain: bool,
    verify: bool,
    silent: bool,
) -> dict[str, Any]:
    """Return what there is to say of a sensor's plan, and say it on stderr unless ``silent``.

    Raises
    ------
    DataError
        The error of ``first`` exceeds the budget.
    """
    if not (explain or verify):
        return {}
    from ertis_numba import kernels
    from ertis_numba.stages.planner import Planner
    from ertis_numba.stages.texture import texture_of

    kernel_set = kernels.load(pipeline.device)
    n_threads = kernel_set.max_threads if threads is None else threads
    settings = pipeline.settings
    texture = texture_of(first, settings, kernel_set, threads=n_threads)
    planners = {
        "safe": Planner(settings, kernel_set, threads=n_threads),
        "texture": Planner(settings, kernel_set, threads=n_threads, texture=texture),
    }
    told: dict[str, Any] = {}
    if explain:
        told["plan"] = _plan(planners, settings)
        _echo(_explained(first.stamp.sensor, told["plan"], settings), silent=silent)
    if verify:
        told["verified"] = _verified(pipeline, first, planners, kernel_set, n_threads)
        _echo(_checked(first.stamp.sensor, told["verified"], settings), silent=silent)
        _require_budget(first.stamp.sensor, told["verified"]["error_db"], settings)
    return told


def _echo(lines: Iterator[str], *, silent: bool) -> None:
    if not silent:
        for line in lines:
            click.echo(line, err=True)


def _plan(planners: dict[str, Any], settings: "Settings") -> dict[str, Any]:
    """Return a plan and what is expected of it, as ``--json`` has it."""
    from ertis_numba.stages.accuracy import PARTS, decibels

    chosen = {name: planner.chosen(settings.accuracy) for name, planner in planners.items()}
    safe, texture = chosen["safe"], chosen["texture"]
    return {
        "accuracy": {name: getattr(settings.accuracy, name) for name in settings.accuracy.__struct_fields__},
        "parts": [
            {
                "name": name,
                "due_to": due_to,
                "safe_db": round(decibels(safe.parts[name]), 1),
                "predicted_db": round(decibels(texture.parts[name]), 1),
            }
            for name, due_to in PARTS.items()
            if safe.parts[name]
        ],
        "safe_db": round(safe.error_db, 1),
        "predicted_db": round(texture.error_db, 1),
        "stages_ms": {name: round(time_ms, 3) for name, time_ms in safe.stages_ms.items()},
        "time_ms": round(safe.time_ms, 3),
        "costs": str(planners["safe"].costs_file),
        "plane_waves": _plane_waves(planners["texture"].model, settings),
    }


def _plane_waves(model: "ErrorModel", settings: "Settings") -> list[dict[str, float]] | None:
    """Return what plane wavefronts are wrong by at both ends of the range axis; None where they are not plane."""
    from ertis_numba.air import sound_speed_m_s
    from ertis_numba.geometry import direction_grid, microphones, unit_vectors
    from ertis_numba.stages.accuracy import decibels
    from ertis_numba.stages.beam_nodes import Aperture

    if settings.processing.wavefront != "plane":
        return None
    grid = direction_grid(settings.processing)
    positions_m = microphones(settings.array).enabled_positions_m
    aperture = Aperture.of(positions_m, unit_vectors(grid.azimuth_rad, grid.elevation_rad))
    speed_m_s = sound_speed_m_s(settings.air)
    return [
        {
            "range_m": range_m,
            "error_db": round(
                decibels(model.plane_waves(aperture, max(range_m, _NEAREST_M), sound_speed_m_s=speed_m_s)), 1
            ),
        }
        for range_m in settings.processing.range_m
    ]


def _explained(sensor: str, plan: dict[str, Any], settings: "Settings") -> Iterator[str]:
    """Yield a plan in words, then its errors and times as a table."""
    accuracy = settings.accuracy
    sample = _INTERPOLATIONS[accuracy.interpolation].format(n=accuracy.delay_taps)
    yield f"plan of {sensor}, for an error of {accuracy.max_error_db:g} dB at the most:"
    precision = "16 bits" if accuracy.precision == "int16" else "single precision"
    kept = options.counted(accuracy.oversampling or 1, "sample")
    yield f"  {precision}, {kept} kept per range, a delayed one is {sample}"
    if accuracy.beam_taps:
        yield (
            f"  beams interpolated from {accuracy.beam_taps} nodes along each axis of the array, "
            f"{accuracy.beam_density:g} of them by what it resolves"
        )
    else:
        yield "  every direction's own beam is summed"
    yield f"  decimation with a stop band of {accuracy.stop_band_db:g} dB"
    if plan["plane_waves"] is None:
        zones = options.counted(accuracy.zones or 1, "zone")
        yield f"  spherical wavefronts, with delays of their own in {zones} of ranges"
    else:
        ends = " and ".join(f"{end['error_db']:.1f} dB at {end['range_m']:g} m" for end in plan["plane_waves"])
        yield f"  plane wavefronts, which are wrong by {ends} against spherical ones, on top of the rest"
    yield _PART.format(name="predicted error", safe="planned", texture="this recording")
    total = {"due_to": "in total", **plan}
    for part in (*plan["parts"], total):
        cells = {key: f"{part[f'{name}_db']:.1f} dB" for key, name in (("safe", "safe"), ("texture", "predicted"))}
        yield _PART.format(name=f"  {part['due_to']}", **cells)
    stages = ", ".join(f"{name} {time_ms:.2f}" for name, time_ms in plan["stages_ms"].items() if time_ms >= _LEAST_MS)
    yield f"  predicted time {plan['time_ms']:.2f} ms: {stages}; by the costs in {plan['costs']}"
    if plan["predicted_db"] > settings.accuracy.max_error_db:
        yield (
            f"  beware: this recording is quieter than was planned for, and its images may err by more than "
            f"{settings.accuracy.max_error_db:g} dB; give a lower --max-error"
        )


def _verified(
    pipeline: "Pipeline", first: "Measurement", planners: dict[str, Any], kernel_set: "KernelSet", threads: int
) -> dict[str, Any]:
    """Return the true error of a measurement beside the predicted ones, as ``--json`` has it."""
    from ertis_numba.verification import measure

    accuracy = pipeline.settings.accuracy
    measured = measure(pipeline.process(first), first, kernels=kernel_set, threads=threads)
    return {
        "sequence": first.stamp.sequence,
        "directions": measured.n_directions,
        "error_db": round(measured.error_db, 2),
        "predicted_db": round(planners["texture"].chosen(accuracy).error_db, 2),
        "safe_db": round(planners["safe"].chosen(accuracy).error_db, 2),
        "max_error_db": accuracy.max_error_db,
        "peaks": measured.peaks and {name: _rounded(value) for name, value in asdict(measured.peaks).items()},
    }


def _checked(sensor: str, verified: dict[str, Any], settings: "Settings") -> Iterator[str]:
    """Yield what was measured against what was predicted."""
    yield (
        f"measurement {verified['sequence']} of {sensor}: error {verified['error_db']:.1f} dB in "
        f"{options.counted(verified['directions'], 'direction')}; predicted {verified['predicted_db']:.1f} dB for this "
        f"recording, {verified['safe_db']:.1f} dB planned; allowed {settings.accuracy.max_error_db:g} dB"
    )
    peaks = verified["peaks"]
    if peaks is None:
        yield "  reflectors were not compared, as the exact image of all directions would take too long"
        return
    line = f"  {peaks['wanted'] - peaks['lost']} of the strongest {options.counted(peaks['wanted'], 'reflector')} found"
    if peaks["level_db"] is not None:
        line += f", within {peaks['level_db']:.3f} dB, {peaks['range_mm']:.3f} mm and {peaks['angle_deg']:.3f}°"
    yield line


def _require_budget(sensor: str, error_db: float, settings: "Settings") -> None:
    from ertis_numba.errors import DataError

    allowed_db = settings.accuracy.max_error_db
    if not error_db <= allowed_db:
        raise DataError(
            f"image of sensor {sensor} errs by {error_db:.1f} dB, allowed are {allowed_db:g} dB; give a lower "
            "--max-error, or leave more of [accuracy] open"
        )


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
