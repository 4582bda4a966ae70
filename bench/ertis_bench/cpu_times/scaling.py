"""Growth of the time with directions, ranges, microphones and threads, relative to the machine's limits."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ertis_bench import checks, input_measurements, machine, timing
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_numba import kernels
from ertis_numba.kernels.benchmarks import ceilings_of_cpu as ceilings
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Settings

__all__ = ["FORMS", "OPERATIONS_PER_POINT", "SERIES", "form", "reached", "run"]

OPERATIONS_PER_POINT = 8  # one complex multiply-add per direction, range and microphone, without a beam grid
_PRECISIONS = ("float32", "int16")
_DEFAULT = "default"  # Name of the default plan. Plans without a beam grid have the name of their precision.
_BASE = {"directions": 1850, "last_range_m": 5.0, "microphones": 32}
SERIES: dict[str, tuple[float, ...]] = {
    "directions": (90, 250, 500, 1000, 1850, 3000, 6000),
    "last_range_m": (1.0, 2.0, 3.0, 4.0, 5.0),
    "microphones": (8, 16, 32, 64, 128, 256),
    "microphones_in_a_square_grid": (64, 256, 1024),
    "batch": (1, 2, 4, 8, 16),
}
"""Varied parameters and their values.

The other values are 1850 directions, 0.5-5 m, 32 microphones, all threads, and the default plan.
"""

_PRESET = "default_25_50"
_FIRST_RANGE_M = 0.5
_APERTURE_M = 0.1
_PITCH_M = 0.0039
_STREAM = 16 * 2**20  # numbers per array: 64 MiB, several times the last-level cache
_TURNS = 200_000
_STRANDS_PER_THREAD = 8


def run(*, count: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure all series on device ``cpu``, and the ceilings."""
    rows = []
    for series, plan in _series():
        say(f"{series}, {plan}: checking and timing {count} measurements each")
        rows += [{"series": series, "plan": plan, **row} for row in _measure(series, plan, count)]
    say("ceilings")
    ceilings_found = [_ceilings(n_threads, count) for n_threads in _thread_counts()]
    return {
        "machine": machine.describe(),
        "rows": rows,
        "count": count,
        "ceilings": ceilings_found,
        "delay_and_sum": [reached(rows, precision, ceilings_found[-1]) for precision in _PRECISIONS],
    }


def _series() -> Iterator[tuple[str, str]]:
    """Yield the series. Directions are also varied without a beam grid, which shows the rate of delay-and-sum."""
    for series in (*SERIES, "threads"):
        for plan in [_DEFAULT, *_PRECISIONS] if series == "directions" else [_DEFAULT]:
            yield series, plan


def _measure(series: str, plan: str, count: int) -> Iterator[dict[str, Any]]:
    """Yield one row per value. The values take turns, so that a drift of the machine does not look like a trend."""
    subjects: dict[str, Callable[[], object]] = {}
    n_ranges: dict[str, int] = {}
    for value in _thread_counts() if series == "threads" else SERIES[series]:
        threads = int(value) if series == "threads" else None
        settings, n_words = _settings(
            plan, **{**_BASE, **({series: value} if series not in {"batch", "threads"} else {})}
        )
        pipeline = Pipeline(settings, "cpu", threads, predict=False)
        measurement = input_measurements.noise(settings, n_words=n_words)
        image = pipeline.process(measurement)
        checks.require_exact(image, measurement)
        subject_of: Callable[[], object] = functools.partial(pipeline.process, measurement, out=image.amplitude)
        if series == "batch":
            subject_of = functools.partial(pipeline.process_batch, [measurement] * int(value))
            checks.require_exact(pipeline.process_batch([measurement] * int(value))[-1], measurement)
        subjects[f"{value:g}"] = subject_of
        n_ranges[f"{value:g}"] = image.amplitude.shape[1]
    for name, times_ms in timing.round_robin(subjects, count=count).items():
        each_ms = times_ms / float(name) if series == "batch" else times_ms
        yield {"value": float(name), "n_ranges": n_ranges[name], **timing.summary(each_ms)}


def _thread_counts() -> list[int]:
    largest = kernels.load("cpu").max_threads
    return [n for n in (1, 2, 4, 8, 16, 32, 64, 128) if n < largest] + [largest]


def _settings(
    plan: str,
    *,
    directions: float,
    last_range_m: float,
    microphones: float,
    microphones_in_a_square_grid: float = 0.0,
) -> tuple[Settings, int]:
    """Return settings and words per sample, with microphones at random positions on a disc, or in a grid."""
    n_mics, settings = int(microphones_in_a_square_grid or microphones), Settings.from_preset(_PRESET)
    if microphones_in_a_square_grid:
        places_m = _PITCH_M * (np.indices((round(n_mics**0.5),) * 2).reshape(2, -1).T - (n_mics**0.5 - 1) / 2)
    else:
        random = np.random.default_rng(1)
        radius_m, angle_rad = _APERTURE_M / 2 * np.sqrt(random.random(n_mics)), 2 * np.pi * random.random(n_mics)
        places_m = np.stack([radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad)], axis=1)
    positions_m = np.column_stack([np.zeros(n_mics), places_m])
    array = Array(layout=f"array of {n_mics}", positions_m=tuple(map(tuple, positions_m.tolist())), word_bits=32)
    processing = settings.processing.replace(
        directions=f"3d:{int(directions)}", range_m=(_FIRST_RANGE_M, float(last_range_m)), wavefront="plane"
    )
    accuracy = settings.accuracy
    if plan != _DEFAULT:
        accuracy = accuracy.replace(max_error_db=checks.MAX_ERROR_DB, precision=plan, beam_taps=0, delay_taps=1)
    settings = settings.replace(array=array, processing=processing, accuracy=accuracy)
    return settings, -(-n_mics // array.word_bits)


def _ceilings(n_threads: int, count: int) -> dict[str, float]:
    """Return the best rates of ``count`` runs. A limit is not an average."""
    a, b, out = (np.ones(_STREAM, dtype=np.float32) for _ in range(3))
    n_strands = n_threads * _STRANDS_PER_THREAD
    strands = {"float32": np.empty(n_strands, dtype=np.float32), "int16": np.empty(n_strands, dtype=np.int32)}
    turn = {"float32": ceilings.multiply_add, "int16": ceilings.dot_16}
    operations = {"float32": ceilings.MULTIPLY_ADD_OPERATIONS, "int16": ceilings.DOT_16_OPERATIONS}
    subjects: dict[str, Callable[[], object]] = {
        "copy": functools.partial(ceilings.copy, a, out),
        "triad": functools.partial(ceilings.triad, a, b, np.float32(2), out),
        **{name: functools.partial(turn[name], _TURNS, strands[name]) for name in _PRECISIONS},
    }
    with kernels.load("cpu").threads(n_threads):
        best_s = {name: float(times.min()) / 1e3 for name, times in timing.round_robin(subjects, count=count).items()}
    return {
        "threads": n_threads,
        "copy_gb_s": round(2 * a.nbytes / best_s["copy"] / 1e9, 1),
        "triad_gb_s": round(3 * a.nbytes / best_s["triad"] / 1e9, 1),
        **{
            f"{name}_gop_s": round(n_strands * _TURNS * operations[name] / best_s[name] / 1e9, 1)
            for name in _PRECISIONS
        },
    }


def reached(rows: list[dict[str, Any]], precision: str, ceiling: dict[str, float]) -> dict[str, Any]:
    """Return the share of the limits that delay-and-sum with envelope reaches.

    Its time per direction is the slope of a line through the times over directions. The intercept of the line is the
    time of the rest of the chain, which does not depend on the number of directions.
    """
    points = [row for row in rows if (row["series"], row["plan"]) == ("directions", precision)]
    directions = np.array([row["value"] for row in points])
    medians_ms = np.array([row["median_ms"] for row in points])
    slope_ms, start_ms = np.polyfit(directions, medians_ms, 1)
    n_ranges = points[0]["n_ranges"]
    gop_s = n_ranges * _BASE["microphones"] * OPERATIONS_PER_POINT / slope_ms / 1e6
    written_gb_s = n_ranges * np.dtype(np.float32).itemsize / slope_ms / 1e6
    return {
        "precision": precision,
        "us_per_direction": round(float(slope_ms) * 1e3, 3),
        "rest_of_chain_ms": round(float(start_ms), 3),
        "gop_s": round(float(gop_s), 1),
        "of_arithmetic": round(float(gop_s) / ceiling[f"{precision}_gop_s"], 3),
        "written_gb_s": round(float(written_gb_s), 2),
        "of_copy": round(float(written_gb_s) * 2 / ceiling["copy_gb_s"], 3),
    }


def form(report: dict[str, Any]) -> str:
    """Return one table per series, the limits, and the reached shares."""
    series: dict[str, list[list[str]]] = {}
    for row in report["rows"]:
        sums = "" if row["plan"] == "default" else f", no beam grid, {row['plan']}"
        name = row["series"].replace("_m", ", m").replace("_", " ") + sums
        series.setdefault(name, []).append([f"{row['value']:g}", timing.in_words(**row), f"{row['n_ranges']}"])
    parts = [table([name, "ms, mean ± std (median)", "ranges"], rows) for name, rows in series.items()]
    columns = {
        "threads": "threads",
        "copy_gb_s": "copy, GB/s",
        "triad_gb_s": "triad, GB/s",
        "float32_gop_s": "float32 multiply-add, Gop/s",
        "int16_gop_s": "16-bit dot product, Gop/s",
    }
    measured = [key for key in columns if key in report["ceilings"][0]]
    rows = [[f"{row[key]:g}" for key in measured] for row in report["ceilings"]]
    parts.append(table([columns[key] for key in measured], rows))
    parts += [_reached(**reached) for reached in report["delay_and_sum"]]
    parts.append(f"Measured on {sentence(report['machine'])}")
    parts.append(
        f"{report['count']} measurements per line, device `cpu`, white noise, the lines of a table in turns of "
        f"{timing.BURST}. Other values are 1850 directions, 0.5–5 m, 32 microphones and all threads. Each line has "
        "the default plan for its settings. If a precision is named, every direction is summed without a beam grid, "
        "with one sample per microphone. Microphones are at random places on a disc of 10 cm, or in a grid of "
        f"{1e3 * _PITCH_M:g} mm; wavefronts are plane. "
        "A batch contains several measurements, and the time is that of one of them. "
        "Every image was compared with the exact one before it was timed; "
        "warm-up calls of a fifth of a second are excluded. "
        "Limits are the best of as many runs, over arrays of 64 MiB and in "
        "registers; a multiplication and an addition are two operations."
    )
    return "\n\n".join(parts)


def _reached(
    *,
    precision: str,
    us_per_direction: float,
    rest_of_chain_ms: float,
    gop_s: float,
    of_arithmetic: float,
    written_gb_s: float,
    of_copy: float,
) -> str:
    return (
        f"Delay-and-sum with envelope in {precision} takes {us_per_direction:.2f} µs per direction (the slope over "
        f"directions; the rest of the chain takes {rest_of_chain_ms:.2f} ms). That is {gop_s:.0f} Gop/s, "
        f"{100 * of_arithmetic:.0f} % of the rate of the arithmetic alone. Its images are written at "
        f"{written_gb_s:.2f} GB/s, {100 * of_copy:.0f} % of the rate of a copy."
    )


FORMS = {"scaling": form}
"""Forms of the table, by the name in its markers."""
