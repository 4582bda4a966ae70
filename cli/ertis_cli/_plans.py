"""Reports of a plan: its steps, its predicted error and time, and its measured error."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options
from ertis_cli._config import typed

if TYPE_CHECKING:
    from ertis_numba.settings import Accuracy

__all__ = ["report_lines", "require_plan", "wavefront_note"]

_MIN_MS = 0.005
_PART = "  {name:52}  {safe:>8}  {predicted:>14}"


def require_plan(method: str | None) -> None:
    """Raise an error for options that need a plan if the method has none."""
    context = click.get_current_context()
    for name in ("explain", "verify", "max_error_db", "plan") if method == "paper" else ():
        value = context.params.get(name)
        if typed(name) if name == "plan" else value is not None and value is not False:  # 0 dB is a budget.
            spelling = f"--{name.removesuffix('_db').replace('_', '-')}"
            raise click.UsageError(f"{spelling} needs --method fast; method 'paper' has no plan", context)


def report_lines(sensor: str, reported: dict[str, Any]) -> Iterator[str]:
    """Yield the lines that report the plan of a sensor and its errors."""
    if "plan" in reported:
        yield from _explained(sensor, reported["plan"])
    if "wavefront_error_db" in reported:
        yield wavefront_note(sensor, reported["wavefront_error_db"], reported["wavefront_error_range_m"])
    if "verified" in reported:
        yield from _checked(sensor, reported["verified"])


def wavefront_note(whose: str, error_db: float, range_m: float) -> str:
    """Return a line on the largest error of plane wavefronts of a sensor or recordings, and its range."""
    return (
        f"{whose}: the error of plane wavefronts is up to {error_db:.1f} dB at {range_m:g} m, in addition to other "
        "errors; use --wavefront auto (capon and method paper support only plane wavefronts), or a larger first range"
    )


def _explained(sensor: str, plan: dict[str, Any]) -> Iterator[str]:
    """Yield a description of a plan, then its errors as a table, then its time."""
    from ertis_numba.settings import Accuracy

    accuracy = Accuracy(**plan["accuracy"])
    yield f"plan of {sensor} for an error budget of {accuracy.max_error_db:g} dB:"
    if plan["budget_applies_to"] == "beams":
        yield (
            "  no plan guarantees this budget for every image of this adaptive beamformer; "
            "this plan meets it for delay-and-sum beams of the same signals"
        )
    elif plan["budget_applies_to"] == "echoes":
        yield "  images of noise, or of many overlapping echoes, may exceed this budget; --verify measures the error"
    precision = "16 bits" if accuracy.precision == "int16" else "single precision"
    yield f"  {precision}, {_delays_in_words(accuracy)}"
    if plan["streams"]:
        yield "  adaptive amplitudes from delay-and-sums of streams, some with fewer taps and coarser beam grids"
    if accuracy.row_beams:
        yield "  the beams of each row of microphones are summed first, and the beams of the array from these"
    if accuracy.beam_taps:
        yield (
            f"  beams interpolated from {accuracy.beam_taps} beam-grid points along each axis of the array, "
            f"{accuracy.beam_density:g} points per resolution cell"
        )
    else:
        yield "  the beam of every direction is summed directly"
    if plan["decimated"]:
        yield f"  decimation with a stopband attenuation of {accuracy.stopband_attenuation_db:g} dB"
    else:
        yield "  PCM without decimation"
    if plan["plane_waves"] is None:
        zones = options.counted(accuracy.focal_zones or 1, "focal zone")
        yield f"  spherical wavefronts, with separate delays in {zones}"
    else:
        ends = " and ".join(f"{end['error_db']:.1f} dB at {end['range_m']:g} m" for end in plan["plane_waves"])
        yield f"  plane wavefronts, with an additional error of {ends} relative to spherical wavefronts"
    yield _PART.format(name="predicted error", safe="planned", predicted="this recording")
    total = {"due_to": "total", **plan}
    for part in (*plan["parts"], total):
        cells = {key: f"{part[f'{name}_db']:.1f} dB" for key, name in (("safe", "safe"), ("predicted", "predicted"))}
        yield _PART.format(name=f"  {part['due_to']}", **cells)
    stages = ", ".join(f"{name} {time_ms:.2f}" for name, time_ms in plan["stages_ms"].items() if time_ms >= _MIN_MS)
    yield f"  predicted time {plan['time_ms']:.2f} ms: {stages}; with the costs in {plan['costs']}"
    if plan["predicted_db"] > accuracy.max_error_db:
        yield (
            f"  warning: this recording is quieter than planned for, and the error of its images may exceed "
            f"{accuracy.max_error_db:g} dB; use a lower --max-error"
        )


def _delays_in_words(accuracy: "Accuracy") -> str:
    """Return a description of how signals are delayed."""
    if accuracy.delay_taps == 0:
        return "exact delays, as phase shifts of spectra"
    taps = accuracy.delay_taps or 1
    interpolated = "one weighted sample" if taps == 1 else f"a weighted sum of {taps} samples"
    return f"{options.counted(accuracy.oversampling or 1, 'sample')} kept per range; a delayed sample is {interpolated}"


def _checked(sensor: str, verified: dict[str, Any]) -> Iterator[str]:
    """Yield the measured error next to the predicted error."""
    yield (
        f"measurement {verified['sequence']} of {sensor}: error {verified['error_db']:.1f} dB in "
        f"{options.counted(verified['directions'], 'direction')}; predicted {verified['predicted_db']:.1f} dB for this "
        f"recording, {verified['safe_db']:.1f} dB planned; allowed {verified['max_error_db']:g} dB"
    )
    peaks = verified["peaks"]
    if peaks is None:
        yield "  reflectors were not compared, because the complete exact image would take too long to compute"
        return
    line = f"  {peaks['wanted'] - peaks['lost']} of the strongest {options.counted(peaks['wanted'], 'reflector')} found"
    if peaks["level_db"] is not None:
        line += f", within {peaks['level_db']:.3f} dB, {peaks['range_mm']:.3f} mm and {peaks['angle_deg']:.3f}°"
    yield line
