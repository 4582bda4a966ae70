"""How the time grows with directions, ranges, microphones and threads, and how near the machine's ceilings it is."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ertis_bench import checks, machine, subject, timing
from ertis_numba import kernels
from ertis_numba.frames import Measurement
from ertis_numba.kernels._cpu import ceilings
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Settings

__all__ = ["FLOPS_PER_POINT", "SERIES", "reached", "run"]

FLOPS_PER_POINT = 8  # one complex multiply-add per direction, range and microphone
_BASE = {"directions": 1850, "last_range_m": 5.0, "microphones": 32}
SERIES: dict[str, tuple[float, ...]] = {
    "directions": (90, 250, 500, 1000, 1850, 3000, 6000),
    "last_range_m": (1.0, 2.0, 3.0, 4.0, 5.0),
    "microphones": (8, 16, 32, 64, 128),
}
"""What is varied; everything else stays at 1850 directions, 0.5-5 m, 32 microphones, all threads."""

_FIRST_RANGE_M = 0.5
_APERTURE_M = 0.1
_STREAM = 16 * 2**20  # numbers of an array: 64 MiB, several times the last cache level
_TURNS = 200_000
_STRANDS_PER_THREAD = 8


def run(*, count: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure all series on device ``cpu``, and the ceilings.

    Parameters
    ----------
    count : int
        Measurements per point.
    say : callable
        Told what goes on.

    Raises
    ------
    DataError
        A result is wrong, so it is not timed.
    """
    rows = []
    for series, value, pipeline, measurement in _points():
        say(f"{series} {value:g}: checking and timing {count} measurements")
        image = pipeline.process(measurement)
        checks.require_exact(image, measurement)
        subjects = {"cpu": functools.partial(pipeline.process, measurement, out=image.energy)}
        times_ms = timing.round_robin(subjects, count=count)["cpu"]
        rows.append(
            {"series": series, "value": value, "n_ranges": image.energy.shape[1], **timing.summary(times_ms)},
        )
    say("measuring ceilings")
    ceilings_found = [_ceilings(n_threads, count) for n_threads in _thread_counts()]
    return {
        "machine": machine.describe(),
        "rows": rows,
        "count": count,
        "ceilings": ceilings_found,
        "delay_and_sum": reached(rows, ceilings_found[-1]),
    }


def _thread_counts() -> list[int]:
    most = kernels.load("cpu").max_threads
    return [n for n in (1, 2, 4, 8, 16, 32, 64, 128) if n < most] + [most]


def _points() -> Iterator[tuple[str, float, Pipeline, Measurement]]:
    for series, values in SERIES.items():
        for value in values:
            settings, n_words = _settings(**{**_BASE, series: value})
            yield series, value, Pipeline(settings, "cpu"), subject.noise(settings, n_words=n_words)
    settings, n_words = _settings(**_BASE)
    for n_threads in _thread_counts():
        yield "threads", n_threads, Pipeline(settings, "cpu", n_threads), subject.noise(settings, n_words=n_words)


def _settings(*, directions: float, last_range_m: float, microphones: float) -> tuple[Settings, int]:
    """Return settings and words per sample, with microphones at random places on a disc."""
    n_mics, settings = int(microphones), Settings.from_preset("default_25_50")
    random = np.random.default_rng(1)
    radius_m = _APERTURE_M / 2 * np.sqrt(random.random(n_mics))
    angle_rad = 2 * np.pi * random.random(n_mics)
    positions_m = np.stack([np.zeros(n_mics), radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad)], axis=1)
    array = Array(layout=f"disc of {n_mics}", positions_m=tuple(map(tuple, positions_m.tolist())), word_bits=32)
    processing = settings.processing.replace(
        directions=f"3d:{int(directions)}", range_m=(_FIRST_RANGE_M, float(last_range_m))
    )
    return settings.replace(array=array, processing=processing), -(-n_mics // array.word_bits)


def _ceilings(n_threads: int, count: int) -> dict[str, float]:
    """Return the best of ``count`` runs: what the machine can do is not an average."""
    a, b, out = (np.ones(_STREAM, dtype=np.float32) for _ in range(3))
    strands = np.empty(n_threads * _STRANDS_PER_THREAD, dtype=np.float32)
    subjects: dict[str, Callable[[], object]] = {
        "copy": functools.partial(ceilings.copy, a, out),
        "triad": functools.partial(ceilings.triad, a, b, np.float32(2), out),
        "multiply_add": functools.partial(ceilings.multiply_add, _TURNS, strands),
    }
    with kernels.load("cpu").threads(n_threads):
        best_s = {name: times.min() / 1e3 for name, times in timing.round_robin(subjects, count=count).items()}
    flops = len(strands) * _TURNS * ceilings.FLOPS_PER_TURN
    return {
        "threads": n_threads,
        "copy_gb_s": round(2 * a.nbytes / best_s["copy"] / 1e9, 1),
        "triad_gb_s": round(3 * a.nbytes / best_s["triad"] / 1e9, 1),
        "multiply_add_gflop_s": round(flops / best_s["multiply_add"] / 1e9, 1),
    }


def reached(rows: list[dict[str, Any]], ceiling: dict[str, float]) -> dict[str, float]:
    """Return what delay-and-sum with envelope reaches of the ceilings.

    Its time per direction is the slope of a line through the times over directions; what does not
    depend on directions, the line's start, is the rest of the chain.

    Parameters
    ----------
    rows : list of dict
        Those of the series ``directions`` are used.
    ceiling : dict
        What the machine does on as many threads.
    """
    points = [row for row in rows if row["series"] == "directions"]
    directions = np.array([row["value"] for row in points])
    medians_ms = np.array([row["median_ms"] for row in points])
    slope_ms, start_ms = np.polyfit(directions, medians_ms, 1, w=1 / medians_ms)
    per_direction = points[0]["n_ranges"] * _BASE["microphones"]
    points_s = per_direction / (slope_ms / 1e3)
    written_gb_s = points[0]["n_ranges"] * 4 / (slope_ms / 1e3) / 1e9
    return {
        "us_per_direction": round(float(slope_ms) * 1e3, 3),
        "rest_of_chain_ms": round(float(start_ms), 3),
        "points_per_s": float(f"{points_s:.3g}"),
        "gflop_s": round(float(points_s) * FLOPS_PER_POINT / 1e9, 1),
        "of_multiply_add": round(float(points_s) * FLOPS_PER_POINT / 1e9 / ceiling["multiply_add_gflop_s"], 3),
        "written_gb_s": round(float(written_gb_s), 2),
        "of_copy": round(float(written_gb_s) * 2 / ceiling["copy_gb_s"], 3),
    }
